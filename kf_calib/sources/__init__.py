"""Where samples come from: files, live links, and the simulated bench."""
