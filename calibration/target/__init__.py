"""The calibration board: its layout, how it is held, and how it is seen."""
