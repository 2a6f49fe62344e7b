"""A run while it runs: session, sequential test, status."""
