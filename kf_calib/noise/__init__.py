"""The noise of readings, within dwells and from dwell to dwell: its model, and its estimation from the misfit."""
