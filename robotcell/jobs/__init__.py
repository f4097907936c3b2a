"""Pick-goal and pick-all: the loop, its verdicts, its journal and its pictures."""
