"""From views to a camera pose with its uncertainty and a verdict."""
