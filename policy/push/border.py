"""The border of an object: what has to be free around it for fingers to come down (paper, stage II)."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

# Paper: the border is 10 dilations by cells of 2 mm wide.
_BORDER_M = 0.020
# Paper, stage II: a push that frees more than tau of its object's border earns the reward, and is worth making.
USEFUL_GAIN = 0.1
# Paper: a cell of the border that is so high is occupied. (There it ends at 0.30 m, above which its map saw nothing.)
_OCCUPIED_M = 0.02


def border_cells(mask: npt.NDArray[np.bool_], resolution_m: float) -> npt.NDArray[np.intp]:
    """(N, 2) row and column of the cells around an object (H, W)."""
    rows, cols = np.nonzero(mask)
    if not len(rows):
        return np.empty((0, 2), np.intp)
    breadth = round(_BORDER_M / resolution_m)
    pad = breadth + 1
    top, left = max(0, rows.min() - pad), max(0, cols.min() - pad)
    inner = mask[top : rows.max() + pad, left : cols.max() + pad].astype(np.uint8)
    ring = (cv2.dilate(inner, np.ones((3, 3), np.uint8), iterations=breadth) > 0) & (inner == 0)
    return np.asarray(np.argwhere(ring) + np.array([top, left]), np.intp)


def is_occupied(height_m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Whether cells of that height are occupied; those that were not seen (NaN) are not."""
    with np.errstate(invalid="ignore"):
        return np.asarray(height_m > _OCCUPIED_M)


def border_occupancy(mask: npt.NDArray[np.bool_], height_m: npt.NDArray[np.float32], resolution_m: float) -> float:
    """Share of the cells around an object that something stands on (paper, stage II: m_r)."""
    rows, cols = border_cells(mask, resolution_m).T
    return float(is_occupied(height_m[rows, cols]).mean()) if len(rows) else 0.0
