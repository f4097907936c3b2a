"""From a decision to a motion: plans, their check against what is in the way, and their supervised run."""
