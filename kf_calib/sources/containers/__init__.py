"""Files that hold arrays in place of letters: MATLAB, HDF5, NumPy and flight logs, each dataset given out as lines."""
