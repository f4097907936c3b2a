"""What a D415 sees: rays, shading, and the errors of the device."""
