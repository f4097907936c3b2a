"""The simulated world: physics, the robot model and everything that stands in the cell."""
