"""The entry point `twin` of the group `robotcell.backends`. Physics and rendering are imported when it connects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotcell.cell import Cell
from robotcell.geometry import rg2
from robotcell.interfaces import Devices, GripperRange
from sim_twin.options import TwinOptions

if TYPE_CHECKING:
    from pydantic import BaseModel

    from robotcell.config import CellConfig
    from sim_twin.scenes.scene import Scene
    from sim_twin.world.world import World


class TwinBackend:
    """A cell whose devices share one simulated world."""

    Options: type[BaseModel] = TwinOptions

    @staticmethod
    def open(config: CellConfig) -> Devices:
        """The twin's devices, not yet connected."""
        return open_twin(config)[0].devices

    @staticmethod
    def cell_name(config: CellConfig) -> None:
        """None: the world is this process's own, and a stop in it ends with it."""

    @staticmethod
    def gripper_range(config: CellConfig) -> GripperRange:
        """What the simulated RG2 reaches with its tips."""
        options = TwinOptions.model_validate(config.backend.options)
        return rg2.range_with_tips(options.fingertip_offset_m)


def open_twin(config: CellConfig, scene: Scene | None = None) -> tuple[Cell, World]:
    """The twin of a configuration, not yet connected, and the world behind it, to score results by.

    Args:
        config: of the cell.
        scene: what stands on the table, in the base frame; that of the options unless given.
    """
    from sim_twin.devices.arm import TwinArm
    from sim_twin.devices.camera import TwinCamera
    from sim_twin.devices.clock import TwinClock
    from sim_twin.devices.gripper import TwinGripper
    from sim_twin.world.world import World

    options = TwinOptions.model_validate(config.backend.options)
    world = World(config, options, scene=scene)
    camera = TwinCamera(world, config.camera, options)
    devices = Devices(TwinArm(world), TwinGripper(world), camera, TwinClock(world))
    return Cell(config, devices), world
