"""The heights of occluded cells: what may stand where the camera did not see.

Unknown is not floor. A cell is occluded because the line of sight to it is blocked, which bounds what can be there
from above; and what the camera sees where the shadow ends is the best guess at what begins inside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array
    from robotcell.perception.heightmap import Heightmap

Heights = npt.NDArray[np.float32]

# A shadow is followed this far over the table at most: that of a 100 mm block under a camera 45 degrees high.
_SHADOW_M = 0.10
# A cell that stands out from the median of its 3x3 neighbours by more than this is a flying pixel.
_SPIKE_M = 0.010


@dataclass(frozen=True)
class CompletedHeights:
    """Heights above the table, completed where the camera did not see.

    Attributes:
        height_m: (H, W) as seen, or else the likely height.
        ceiling_m: (H, W) as seen, or else the greatest height that could have stayed unseen.
    """

    height_m: Heights
    ceiling_m: Heights


def complete_heights(
    heightmap: Heightmap, camera: Array, table_height_m: float, wanted: npt.NDArray[np.bool_] | None = None
) -> CompletedHeights:
    """Complete a heightmap along the lines of sight.

    Going from an unknown cell towards the camera, each seen cell bounds what may be hidden: the line from the
    camera to the top of the unknown must pass below that cell's surface. Going away from the camera, the first
    seen cell tells what the shadow falls on; the likely height is that one's, no higher than the bound.

    Args:
        heightmap: with NaN where nothing was seen.
        camera: position (3,) in the base frame [m].
        table_height_m: z of the table in the base frame.
        wanted: (H, W) where it is to be complete; elsewhere unknown cells are left NaN. None for everywhere.
    """
    workspace = heightmap.workspace
    known = _without_spikes(heightmap.closed_m)
    unknown = np.isnan(known)
    rows, cols = np.nonzero(unknown if wanted is None else unknown & wanted)
    height, ceiling = known.copy(), known
    eye_row = (camera[1] - workspace.y[0]) / workspace.resolution_m - 0.5
    eye_col = (camera[0] - workspace.x[0]) / workspace.resolution_m - 0.5
    eye_height = camera[2] - table_height_m
    distance = np.maximum(np.hypot(eye_row - rows, eye_col - cols), 1e-6)
    d_row, d_col = (eye_row - rows) / distance, (eye_col - cols) / distance

    bound = np.zeros(len(rows), np.float32)
    likely = np.full(len(rows), np.nan, np.float32)
    for step in range(1, int(_SHADOW_M / workspace.resolution_m) + 1):
        share = np.minimum(step / distance, 0.99)
        towards = _look_up(known, rows + step * d_row, cols + step * d_col)
        bound = np.fmax(bound, (towards - eye_height * share) / (1 - share)).astype(np.float32)
        open_end = np.flatnonzero(np.isnan(likely))
        likely[open_end] = _look_up(
            known, rows[open_end] - step * d_row[open_end], cols[open_end] - step * d_col[open_end]
        )
    height[rows, cols] = np.clip(np.nan_to_num(likely, nan=0.0), 0, bound)
    ceiling[rows, cols] = bound
    return CompletedHeights(height, ceiling)


def _without_spikes(height_m: Heights) -> Heights:
    """A copy in which single cells do not stand out from their neighbours."""
    zeroed = np.nan_to_num(height_m, nan=0.0)
    return np.asarray(np.minimum(height_m, cv2.medianBlur(zeroed, 3) + np.float32(_SPIKE_M)), np.float32)


def _look_up(heights: Heights, rows: Array, cols: Array) -> Heights:
    """Heights at the nearest cells; NaN where unknown or outside."""
    r, c = np.rint(rows).astype(np.intp), np.rint(cols).astype(np.intp)
    inside = (r >= 0) & (r < heights.shape[0]) & (c >= 0) & (c < heights.shape[1])
    return np.where(inside, heights[np.where(inside, r, 0), np.where(inside, c, 0)], np.float32(np.nan))
