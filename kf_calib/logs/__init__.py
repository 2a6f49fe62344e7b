"""Logs that hold arrays in place of letters: MATLAB, HDF5, NumPy and flight logs; imported to read one."""
