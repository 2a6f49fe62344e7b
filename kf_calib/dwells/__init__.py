"""From a stream of samples to square-root sufficient statistics of each dwell."""
