"""Logs that hold arrays in place of letters: MATLAB, HDF5, NumPy, TDMS, Parquet, flight logs; imported to read one."""
