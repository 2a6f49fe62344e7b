"""Whatever is written in letters, logs of samples and tables of means alike: from bytes to lines and their heading."""
