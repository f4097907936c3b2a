"""Views from other programs' files."""
