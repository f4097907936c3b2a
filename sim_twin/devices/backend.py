"""The entry point `twin` of the group `robotcell.backends`. Physics and rendering are imported when it connects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from robotcell.cell import Cell
from robotcell.geometry.transforms import make_transform, rotvec_to_matrix
from robotcell.interfaces import Devices
from sim_twin.d415.noise import NoiseOptions

if TYPE_CHECKING:
    from robotcell.config import CameraMount, CellConfig
    from robotcell.geometry.transforms import Array
    from sim_twin.world.world import World


class TwinOptions(BaseModel):
    """`backend.options` of a twin.

    Attributes:
        scene: name of a built-in scene, or path of a scene file.
        objects: how many objects a random scene has.
        seed: of the scene and of the camera's noise; the same seed gives the same job.
        meshes: folder of the OBJ files that a scene file names.
        noise: what the camera adds to the truth.
        board: the gripper holds the calibration board (docs/calibration.md), a little differently for each seed.
        tag: a tag lies on the table beside the workspace, as one that is fixed to a cell (robotcell/drift.py).
        camera_offset: how far the camera really stands from where `camera` has it without a calibration: position [m]
            and rotation vector [rad], base axes. A camera that was moved, or never measured.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str = "random"
    objects: Annotated[int, Field(ge=1, le=60)] = 10
    seed: Annotated[int, Field(ge=0)] = 0
    meshes: Path | None = None
    noise: NoiseOptions = NoiseOptions()
    board: bool = False
    tag: bool = False
    camera_offset: tuple[float, float, float, float, float, float] = (0.0,) * 6

    def camera_pose(self, mount: CameraMount) -> Array:
        """T_base_camera (4, 4) of where the twin's camera really stands, whatever a calibration says of it."""
        T = mount.nominal()
        d, turn = self.camera_offset[:3], rotvec_to_matrix(self.camera_offset[3:])
        return make_transform(turn @ T[:3, :3], T[:3, 3] + d)


class TwinBackend:
    """A cell whose devices share one simulated world."""

    Options: type[BaseModel] = TwinOptions

    @staticmethod
    def open(config: CellConfig) -> Devices:
        """The twin's devices, not yet connected."""
        return open_twin(config)[0].devices


def open_twin(config: CellConfig) -> tuple[Cell, World]:
    """The twin of a configuration, not yet connected, and the world behind it, to score results by."""
    from sim_twin.devices.arm import TwinArm
    from sim_twin.devices.camera import TwinCamera
    from sim_twin.devices.clock import TwinClock
    from sim_twin.devices.gripper import TwinGripper
    from sim_twin.world.world import World

    options = TwinOptions.model_validate(config.backend.options)
    world = World(config, options)
    camera = TwinCamera(world, config.camera, options.noise, options.seed, options.camera_pose(config.camera))
    devices = Devices(TwinArm(world), TwinGripper(world), camera, TwinClock(world))
    return Cell(config, devices), world
