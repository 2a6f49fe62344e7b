"""Files that hold arrays in place of letters: which they are, and each of their datasets, given out as lines."""
