"""The geometric policy."""
