"""A heightmap as the network sees it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

CHANNELS = 5
# Channels of the Q maps that it answers with; here, so that who only plays scenes need not import torch.
GRASP, PUSH = 0, 1
# Cells of the maps that the networks are trained on and work at (paper: 2 mm).
RESOLUTION_M = 0.002

# Brings block heights (2.5 to 10 cm) to the order of one.
_HEIGHT_SCALE_M = 0.05
# Taller things look alike: the networks were trained on heights up to this, at which the paper ends.
_HIGHEST_M = np.float32(0.30)


def encode(height_m: npt.NDArray[np.float32], color: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """(..., 5, H, W) float32: height, seen, red, green, blue.

    A hole (the shadow behind an object) is 0 in the plane `seen`, which is 1 elsewhere, and so in all planes, like the
    world beyond the map. Heights are in units of 5 cm, colours in -1..1. What is taller than 30 cm is
    shown as 30 cm.

    Args:
        height_m: (..., H, W) [m] above the table with the gaps between pixels closed, NaN = unknown.
        color: (..., H, W, 3) uint8 RGB, black where nothing was seen.
    """
    holes = np.isnan(height_m)
    planes = np.empty((*height_m.shape[:-2], CHANNELS, *height_m.shape[-2:]), np.float32)
    planes[..., 0, :, :] = np.where(holes, 0, np.clip(height_m, 0, _HIGHEST_M)) / _HEIGHT_SCALE_M
    planes[..., 1, :, :] = ~holes
    seen = np.any(color, axis=-1, keepdims=True)
    planes[..., 2:, :, :] = np.moveaxis(np.where(seen, color * np.float32(1 / 127.5) - 1, np.float32(0)), -1, -3)
    return planes
