"""Hand-eye calibration of the fixed camera."""
