"""The segmentation of sample streams into dwells, and the square-root sufficient statistics of each dwell."""
