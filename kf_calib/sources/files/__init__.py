"""Recordings: MCAP, CSV and JSON lines, read and written."""
