"""The entry point `hardware` of the group `robotcell.backends`. Each device imports its library when it connects."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415, D415Options
from robotcell.drivers.rg2 import RG2, RG2Options
from robotcell.drivers.ur5e.arm import UR5e, UR5eOptions
from robotcell.geometry import rg2
from robotcell.interfaces import Devices, GripperRange

if TYPE_CHECKING:
    from robotcell.config import CellConfig


class HardwareOptions(BaseModel):
    """`backend.options` of a cell with real devices, or with devices that a twin serves."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    arm: UR5eOptions
    gripper: RG2Options
    camera: D415Options = D415Options()


class HardwareBackend:
    """A cell of a UR5e, an RG2 behind a Compute Box and a D415."""

    Options: type[BaseModel] = HardwareOptions

    @staticmethod
    def open(config: CellConfig) -> Devices:
        """The devices of a configuration, not yet connected."""
        options = HardwareOptions.model_validate(config.backend.options)
        clock = WallClock()
        return Devices(
            UR5e(options.arm, clock),
            RG2(options.gripper, clock),
            D415(options.camera, config.camera, clock),
            clock,
        )

    @staticmethod
    def cell_name(config: CellConfig) -> str:
        """The address of the arm's controller, whichever of its names the file uses."""
        host = HardwareOptions.model_validate(config.backend.options).arm.host
        try:
            found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            # Whatever it is, connecting will say what is wrong with it.
            return f"arm-{host.lower()}"
        return f"arm-{min(str(address[4][0]) for address in found)}"

    @staticmethod
    def gripper_range(config: CellConfig) -> GripperRange:
        """What the RG2 reaches with the tips that the options say are mounted."""
        options = HardwareOptions.model_validate(config.backend.options)
        return rg2.range_with_tips(options.gripper.fingertip_offset_m)
