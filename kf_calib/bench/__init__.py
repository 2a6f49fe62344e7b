"""The bench: gimbals, rotations, gravity, sample streams and the paper's twelve parameters."""
