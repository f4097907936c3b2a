"""One view as it stands in a file: where the flange was, and the corners in the image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibration.solve.readers.validation import validate
from calibration.solve.se3 import nearest_rotation
from calibration.solve.views import Corners, Views
from robotcell.config.calibration_file import CameraModel, CharucoBoard, Mount, PointBoard
from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    from robotcell.config.calibration_file import Board
    from robotcell.geometry.transforms import Array

# Files with three printed digits stay below it; they are brought to the nearest rotation.
_ROTATION_TOLERANCE = 5e-3


class CornerRecord(BaseModel):
    """One view of a file with corners.

    Attributes:
        name: of the view.
        T_base_flange: 4x4, metres.
        ids: of the corners; may be empty where the board was not found.
        corners_px: (x, y) of each [px], the centre of the first pixel is (0, 0).
        depth_m: of each in the depth image, 0 = no return; none without a depth image.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: Annotated[str, Field(min_length=1)]
    T_base_flange: list[list[float]]
    ids: list[int]
    corners_px: list[tuple[float, float]]
    depth_m: list[float] | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> CornerRecord:
        if len(self.ids) != len(self.corners_px):
            raise ValueError(f"{len(self.ids)} ids and {len(self.corners_px)} corners_px; there must be one of each")
        if self.depth_m is not None and len(self.depth_m) != len(self.ids):
            raise ValueError(f"{len(self.ids)} ids and {len(self.depth_m)} depth_m; there must be one of each")
        if len(set(self.ids)) != len(self.ids):
            raise ValueError("an id appears twice")
        return self


def views_of_corners(
    records: Sequence[CornerRecord],
    mount: Mount,
    camera: CameraModel,
    board: Board,
    date: datetime,
    file: Path,
) -> Views:
    """Views of records with corners.

    Raises:
        ConfigError: a name appears twice, an id is not on the board, a corner is outside the image, or a pose is wrong.
    """
    known = board.corners()
    poses, corners, names = [], [], set()
    for record in records:
        place = f"{file}: view {record.name}"
        if record.name in names:
            raise ConfigError(f"{place}: the name appears twice")
        names.add(record.name)
        strangers = sorted(set(record.ids) - set(known))
        if strangers:
            raise ConfigError(f"{place}: ids: {strangers[:5]} are not on the board ({len(known)} corners)")
        px = np.array(record.corners_px, dtype=np.float64).reshape(-1, 2)
        # Half a pixel around the image is still its edge.
        if ((px < -0.5) | (px > (camera.width - 0.5, camera.height - 0.5))).any():
            raise ConfigError(f"{place}: corners_px: outside the image of {camera.width}x{camera.height}")
        poses.append(parse_pose(record.T_base_flange, f"{place}: T_base_flange"))
        depth = None if record.depth_m is None else np.array(record.depth_m, dtype=np.float64)
        corners.append(Corners(np.array(record.ids, dtype=np.int64), px, depth))
    return Views(
        mount=mount,
        names=tuple(record.name for record in records),
        T_base_flange=np.stack(poses) if poses else np.empty((0, 4, 4)),
        date=date,
        corners=tuple(corners),
        camera=camera,
        board=board,
    )


def parse_pose(values: Any, place: str) -> Array:
    """A (4, 4) rigid transform; its rotation is made exact. Its determinant may be -1: the verdict is on the whole set.

    Raises:
        ConfigError: naming `place` and what is wrong.
    """
    try:
        T = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{place}: not a 4x4 matrix of numbers") from None
    if T.shape != (4, 4):
        raise ConfigError(f"{place}: has shape {T.shape}; a 4x4 matrix is needed")
    if not np.isfinite(T).all():
        raise ConfigError(f"{place}: contains NaN or infinity")
    if not np.allclose(T[3], (0, 0, 0, 1)):
        transposed = " (it looks transposed)" if np.allclose(T[:, 3], (0, 0, 0, 1)) else ""
        raise ConfigError(f"{place}: the last row is {T[3].tolist()}; it must be 0 0 0 1{transposed}")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE):
        raise ConfigError(f"{place}: not rigid: its rotation part is not orthonormal")
    handedness = np.sign(np.linalg.det(R))
    T[:3, :3] = handedness * nearest_rotation(handedness * R)
    return T


def parse_board(values: Any, place: str) -> Board:
    """A ChArUco board, or points.

    Raises:
        ConfigError: naming `place` and every wrong field.
    """
    if isinstance(values, dict) and "points" in values:
        return validate(PointBoard, values, place)
    return validate(CharucoBoard, values, place)
