"""What stands on the twin's table: solids, scenes, and scene files."""
