"""Where a push begins: a cell of the push maps is what is pushed, and the fingers come down behind it.

The paper's cell is the start itself. Here it is the place on an object through which the push passes, so that the
goal's mask selects pushes of the goal also where neighbours leave no room for the fingers beside it; the start follows
from the heightmap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.geometry import rg2
from robotcell.motion.rotations import rotation_angle_rad
from robotcell.perception.segmentation import MIN_OBJECT_M

if TYPE_CHECKING:
    from robotcell.config import Workspace
    from robotcell.geometry.transforms import Array

# Room that the closed fingers need to come down: half their diagonal, and 1 mm for noise and calibration.
_FREE_RADIUS_M = 0.016
# What stands higher than this is in their way.
_FREE_HEIGHT_M = 0.008
# Cranks and body of the gripper keep this distance from what they pass.
_SIDE_MARGIN_M = 0.003
# Where something is too high for them, the fingers come down so much farther back.
_STEPS_BACK_M = (0.0, 0.004, 0.008, 0.012)
# The push must still go on for this far behind the cell that it was chosen for.
_FOLLOW_M = 0.010
# The height of what is met is taken over so much of its face: the first cells of an edge are uncertain.
_FACE_M = 0.014


@dataclass(frozen=True)
class PushLine:
    """A push through a cell.

    Attributes:
        row, col: cell where the closed fingers come down.
        top_m: height of what they meet first [m above the table].
        cells: (N, 2) row and column of every cell on the way of the finger tips, from the start on.
    """

    row: int
    col: int
    top_m: float
    cells: npt.NDArray[np.intp]


def free_to_descend(height_m: npt.NDArray[np.float32], workspace: Workspace) -> npt.NDArray[np.bool_]:
    """(H, W) cells at which the closed fingers come down on nothing: all around is seen and low.

    Args:
        height_m: (H, W) with closed gaps, NaN where nothing was seen.
        workspace: for the size of its cells.
    """
    with np.errstate(invalid="ignore"):
        blocked = ~(height_m < _FREE_HEIGHT_M)
    size = 2 * math.ceil(_FREE_RADIUS_M / workspace.resolution_m) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    # Beyond the map nothing is known.
    grown = cv2.dilate(blocked.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(grown == 0)


def push_starts(
    free: npt.NDArray[np.bool_], cells: npt.NDArray[np.intp], rotation: int, push_m: float, resolution_m: float
) -> npt.NDArray[np.intp]:
    """(N, 2) row and column at which pushes through cells (N, 2) begin, -1 where there is no place.

    Going back from a cell, the fingers come down at the first place that is free for them.
    """
    length = round(push_m / resolution_m)
    back = np.arange(length - round(_FOLLOW_M / resolution_m) + 1)
    places = np.rint(cells[:, :, None] - _direction(rotation)[:, None] * back).astype(np.intp)
    # Once outside of the map, a way back does not return to it.
    inside = np.all((places >= 0) & (places < np.array(free.shape)[:, None]), axis=1)
    row, col = np.where(inside[:, None], places, 0).swapaxes(0, 1)
    possible = np.logical_and(inside, free[row, col])
    first = possible.argmax(axis=1)
    found = possible.any(axis=1)
    return np.where(found[:, None], places[np.arange(len(cells)), :, first], -1)


def push_line(
    height_m: npt.NDArray[np.float32],
    free: npt.NDArray[np.bool_],
    cell: tuple[int, int],
    rotation: int,
    push_m: float,
    resolution_m: float,
) -> PushLine | None:
    """The push of length `push_m` in direction `rotation` through a cell; None where there is none."""
    row, col = push_starts(free, np.array([cell]), rotation, push_m, resolution_m)[0]
    return None if row < 0 else _line_from(height_m, free, (int(row), int(col)), rotation, push_m, resolution_m)


def _line_from(
    height_m: npt.NDArray[np.float32],
    free: npt.NDArray[np.bool_],
    start: tuple[int, int],
    rotation: int,
    push_m: float,
    resolution_m: float,
) -> PushLine | None:
    """The push from a free start on, or from a little farther back, where what stands around it is not too high.

    None where there is no such place, or where the push meets nothing.
    """
    for back_m in _STEPS_BACK_M:
        row, col = np.rint(start - round(back_m / resolution_m) * _direction(rotation)).astype(np.intp).tolist()
        if not (0 <= row < free.shape[0] and 0 <= col < free.shape[1] and free[row, col]):
            return None
        line = _line((row, col), height_m, rotation, push_m, resolution_m)
        if line is None or not _gripper_touches(height_m, line, rotation, resolution_m):
            return line
    return None


def _line(
    start: tuple[int, int], height_m: npt.NDArray[np.float32], rotation: int, push_m: float, resolution_m: float
) -> PushLine | None:
    length = round(push_m / resolution_m)
    way = np.rint(np.array(start)[:, None] + _direction(rotation)[:, None] * np.arange(length + 1)).astype(np.intp)
    outside = np.flatnonzero(((way < 0) | (way >= np.array(height_m.shape)[:, None])).any(axis=0))
    cells = way.T[: outside[0]] if len(outside) else way.T
    profile = np.nan_to_num(height_m[cells[:, 0], cells[:, 1]], nan=0.0)
    met = np.flatnonzero(profile > MIN_OBJECT_M)
    if not len(met):
        return None
    face = profile[met[0] : met[0] + round(_FACE_M / resolution_m)]
    return PushLine(start[0], start[1], float(face.max()), cells)


def _gripper_touches(height_m: npt.NDArray[np.float32], line: PushLine, rotation: int, resolution_m: float) -> bool:
    """Whether something around a start reaches up to the gripper above the tips of its closed fingers."""
    tip_m = line.top_m / 2
    for part, above_m in (
        (rg2.CRANKS_M, rg2.CRANKS_ABOVE_TIPS_M),
        (rg2.BODY_M, rg2.BODY_ABOVE_TIPS_M),
    ):
        cells = np.array([[line.row], [line.col]]) + _beneath(part, rotation, resolution_m)
        row, col = cells[:, ((cells >= 0) & (cells < np.array(height_m.shape)[:, None])).all(axis=0)]
        if (height_m[row, col] > tip_m + above_m).any():
            return True
    return False


@lru_cache(maxsize=64)
def _beneath(half_m: tuple[float, float], rotation: int, resolution_m: float) -> npt.NDArray[np.intp]:
    """(2, N) rows and columns, from the middle, of the cells beneath a rectangle that runs along a direction."""
    half = (np.array(half_m) + _SIDE_MARGIN_M) / resolution_m
    reach = math.ceil(np.hypot(*half))
    cells = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    along, across = _direction(rotation) @ cells, normal(rotation) @ cells
    return np.asarray(cells[:, (np.abs(along) <= half[0]) & (np.abs(across) <= half[1])])


def normal(rotation: int) -> Array:
    """(2,) unit step in rows and in columns to the side of a push."""
    along = _direction(rotation)
    return np.array([along[1], -along[0]])


def _direction(rotation: int) -> Array:
    """Steps in rows, which run along y, and in columns, which run along x."""
    theta = rotation_angle_rad(rotation)
    return np.array([math.sin(theta), math.cos(theta)])
