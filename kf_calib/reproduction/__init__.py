"""The experiment of the paper that the program began with."""
