"""The `robotcell` command: parsing, progress and printing."""
