"""The OnRobot RG2 behind a Compute Box, over Modbus TCP."""

from robotcell.drivers.rg2.gripper import RG2, RG2Options

__all__ = ["RG2", "RG2Options"]
