"""Servers that speak the wire protocols of UR5e, RG2 and D415 for one simulated cell in real time."""
