"""Taking the views of a calibration."""
