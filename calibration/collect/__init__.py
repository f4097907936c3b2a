"""Taking the views of a calibration: `acquisition` goes to planned poses, `session` keeps what was captured."""
