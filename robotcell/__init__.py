"""Hardware control of a UR5e, RG2 and D415 pick cell."""
