"""`cell.toml` and the calibration file: what a cell is, read and checked."""
