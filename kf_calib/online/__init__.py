"""Evaluation of a run while it is being recorded: session, sequential test and status."""
