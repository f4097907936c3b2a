"""From a frame to what lies on the table."""
