"""The twin: the cell's devices over a pybullet world."""
