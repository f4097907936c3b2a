"""What the learner looks at: the surroundings of an attempt, turned so that it runs along +x, as they are or varied."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from policy.network.encoding import GRASP, RESOLUTION_M, encode
from policy.network.rotation import turn_matrix
from policy.training.shard import unpack_height
from robotcell.motion.rotations import ROTATIONS

if TYPE_CHECKING:
    from policy.training.replay import View

# Side of a crop: a push begins up to 90 mm behind its cell and ends up to 100 mm beyond it.
CROP_M = 0.224
CROP_CELLS = round(CROP_M / RESOLUTION_M)

# Turned a little further than the action; a grasp or a push does not depend on a few degrees.
_TURN_RAD = 0.06
# Off the cell that was tried, likewise.
_SHIFT_M = 0.0014
# Light and white balance: gain of the whole picture, and of each colour.
_BRIGHTNESS = (0.7, 1.3)
_BALANCE = (0.85, 1.15)
# Error of the table's height that a calibration leaves.
_OFFSET_M = 0.0007


def crop(
    view: View,
    primitive: int,
    cell: tuple[int, int],
    rotation: int,
    rng: np.random.Generator | None,
    side: int = CROP_CELLS,
) -> npt.NDArray[np.float32]:
    """(5, side, side) encoded surroundings of a cell, which lies in the middle.

    Args:
        view: (H, W) of the state.
        primitive: a grasp may be seen from either side.
        cell: (row, column).
        rotation: of the attempt.
        rng: of the variations: a little turn and shift, mirror image, colours, table height. None for none.
        side: rows and columns of the crop.
    """
    if rng is not None and primitive == GRASP and rng.random() < 0.5:
        rotation += ROTATIONS // 2
    middle = (side / 2, side / 2)
    M = turn_matrix(rotation, cell, (0.0, 0.0))
    if rng is not None:
        cos, sin = math.cos(angle := rng.normal(0, _TURN_RAD)), math.sin(angle)
        M = np.array([[cos, -sin], [sin, cos]]) @ M
        M[:, 2] += rng.normal(0, _SHIFT_M / RESOLUTION_M, 2)
        if rng.random() < 0.5:
            M[1] *= -1
    M[:, 2] += middle
    height, color = (
        cv2.warpAffine(image, M, (side, side), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        for image in (view.height, view.color)
    )
    heights = unpack_height(np.asarray(height, np.uint16))
    if rng is not None:
        gains = rng.uniform(*_BRIGHTNESS) * rng.uniform(*_BALANCE, size=3)
        color = np.clip(color[:, :, rng.permutation(3)] * gains, 0, 255)
        heights += np.float32(rng.normal(0, _OFFSET_M))
    return encode(heights, np.asarray(color, np.uint8))
