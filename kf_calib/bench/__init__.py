"""What the platform makes the block feel: gimbals, rotations, gravity, sample streams, the twelve parameters."""
