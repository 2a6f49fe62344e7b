"""Many recordings evaluated at once: a table with one row for each run, and what all runs together show."""
