"""Looks at every device of a hardware cell and says what is wrong. Start at `examine`."""
