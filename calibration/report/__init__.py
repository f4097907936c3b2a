"""The report of a calibration: `page` writes it."""
