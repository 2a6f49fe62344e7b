"""Files, locks, text and progress, whatever they are of."""
