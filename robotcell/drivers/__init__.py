"""Drivers of the real devices. Each imports its vendor's library when it connects."""
