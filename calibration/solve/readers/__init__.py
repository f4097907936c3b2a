"""Views and poses over time from other programs' files: `view_file.read_file`, `pose_csv.read_series`."""
