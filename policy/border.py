"""The border of an object: what has to be free around it for fingers to come down (paper, stage II)."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

# Paper: the border is 10 dilations wide; a cell of it from 2 cm to 30 cm high is occupied.
BORDER_DILATIONS = 10
OCCUPIED_M = (0.02, 0.30)


def border_occupancy(mask: npt.NDArray[np.bool_], height_m: npt.NDArray[np.float32]) -> float:
    """Share of the cells around an object that something stands on (paper, stage II: m_r)."""
    rows, cols = np.nonzero(mask)
    if not len(rows):
        return 0.0
    pad = BORDER_DILATIONS + 1
    window = (slice(max(0, rows.min() - pad), rows.max() + pad), slice(max(0, cols.min() - pad), cols.max() + pad))
    inner = mask[window].astype(np.uint8)
    border = (cv2.dilate(inner, np.ones((3, 3), np.uint8), iterations=BORDER_DILATIONS) > 0) & (inner == 0)
    heights = height_m[window][border]
    with np.errstate(invalid="ignore"):
        occupied = (heights > OCCUPIED_M[0]) & (heights < OCCUPIED_M[1])
    return float(occupied.mean()) if len(heights) else 0.0
