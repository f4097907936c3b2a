"""Calibration of the camera to the arm: from views of a board to a pose with its uncertainty and a verdict.

`procedure` calibrates a cell and `verify` checks a calibration on the table; the other folders are its stages.
"""
