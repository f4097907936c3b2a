"""A heightmap as the network sees it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from robotcell.heightmap import close_gaps

CHANNELS = 5

# Brings block heights (2.5 to 10 cm) to the order of one.
_HEIGHT_SCALE_M = 0.05


def encode(height_m: npt.NDArray[np.float32], color: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """(5, H, W) float32: height, holes, red, green, blue.

    Gaps between pixels are closed; what stays unknown (the shadow behind an object) has height 0 and 1 in the channel
    of the holes. Heights are in units of 5 cm, colours in -1..1, 0 where nothing was seen.

    Args:
        height_m: (H, W) [m] above the table, NaN = never seen.
        color: (H, W, 3) uint8 RGB.
    """
    closed = close_gaps(height_m)
    holes = np.isnan(closed)
    planes = np.empty((CHANNELS, *height_m.shape), np.float32)
    planes[0] = np.where(holes, 0, np.clip(closed, 0, None)) / _HEIGHT_SCALE_M
    planes[1] = holes
    planes[2:] = np.moveaxis(color, 2, 0) * np.float32(1 / 127.5) - 1
    planes[2:, np.isnan(height_m)] = 0
    return planes
