"""`backend.options` of a twin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from robotcell.geometry.transforms import make_transform, rotvec_to_matrix

if TYPE_CHECKING:
    from robotcell.config import CameraMount
    from robotcell.geometry.transforms import Array


class NoiseOptions(BaseModel):
    """Which errors of the D415 the twin's camera shows.

    Attributes:
        disparity_noise: noise of the disparity, so that depth noise grows with the square of the distance.
        quantisation: depth comes in steps.
        edge_bleeding: edges wander, and pixels hang between front and back.
        dropout: pixels without depth, many where the surface is seen at a low angle.
        occlusion: no depth where only one of the two imagers sees the surface.
        warm_up: the exposure settles within the first 30 frames.
        color_noise: blur and noise of the colour image.
        white_balance: exposure and white balance wander.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    disparity_noise: bool = True
    quantisation: bool = True
    edge_bleeding: bool = True
    dropout: bool = True
    occlusion: bool = True
    warm_up: bool = True
    color_noise: bool = True
    white_balance: bool = True


class IntrinsicsError(BaseModel):
    """By how much the intrinsics that the twin's camera reports differ from those that it sees with.

    Attributes:
        focal: relative error of both focal lengths; 0.01 reports them 1 % too long.
        cx_px: error of the principal point along a row [px].
        cy_px: error of the principal point along a column [px].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    focal: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    cx_px: Annotated[float, Field(ge=-50, le=50)] = 0.0
    cy_px: Annotated[float, Field(ge=-50, le=50)] = 0.0


class DepthError(BaseModel):
    """By how much the depth that the twin's camera delivers is off, besides its noise: scale * depth + offset_m.

    Attributes:
        scale: 1.01 delivers depths 1 % too long.
        offset_m: what is added then [m].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scale: Annotated[float, Field(ge=0.8, le=1.2)] = 1.0
    offset_m: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.0


class TwinOptions(BaseModel):
    """`backend.options` of a twin.

    Attributes:
        scene: name of a built-in scene, or path of a scene file.
        objects: how many objects a random scene has.
        seed: of the scene and of the camera's noise; the same seed gives the same job.
        meshes: folder of the mesh files that a scene file names.
        noise: what the camera adds to the truth.
        fingertip_offset_m: how far each mounted finger tip reaches inwards from the bare finger.
        board: the gripper holds the calibration board (docs/how-to/calibrate.md), a little differently for each seed.
        tag: a tag lies on the table beside the workspace, as one that is fixed to a cell (robotcell.perception.tags).
        camera_offset: how far the camera really stands from where `camera` has it without a calibration: position [m]
            and rotation vector [rad], base axes. A camera that was moved, or never measured.
        intrinsics_error: of the intrinsics that the camera reports; what it sees stays as it is.
        depth_error: of the depth that the camera delivers.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str = "random"
    objects: Annotated[int, Field(ge=1, le=60)] = 10
    seed: Annotated[int, Field(ge=0)] = 0
    meshes: Path | None = None
    noise: NoiseOptions = NoiseOptions()
    fingertip_offset_m: Annotated[float, Field(ge=-0.008, le=0.04)] = 0.0
    board: bool = False
    tag: bool = False
    camera_offset: tuple[float, float, float, float, float, float] = (0.0,) * 6
    intrinsics_error: IntrinsicsError = IntrinsicsError()
    depth_error: DepthError = DepthError()

    def camera_pose(self, mount: CameraMount) -> Array:
        """T_base_camera (4, 4) of where the twin's camera really stands, whatever a calibration says of it."""
        T = mount.nominal()
        d, turn = self.camera_offset[:3], rotvec_to_matrix(self.camera_offset[3:])
        return make_transform(turn @ T[:3, :3], T[:3, 3] + d)
