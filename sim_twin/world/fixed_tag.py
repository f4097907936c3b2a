"""A tag that lies on the twin's table beside the workspace, by which a moved camera is noticed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from robotcell.perception.tags import FAMILY
from sim_twin.visual import Visual

if TYPE_CHECKING:
    from robotcell.config import CellConfig

TAG_ID = 7
_SIDE_M = 0.060
# White round the tag, as a share of its side; without it no detector finds it.
_QUIET = 0.2
_BESIDE_M = 0.10
_THICKNESS_M = 0.001
_BIT_PX = 24


def tag_visual(config: CellConfig) -> Visual:
    """The sheet with the tag, in the base frame, on the side of the workspace where no bin is."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
    bits = dictionary.markerSize + 2
    tag = cv2.aruco.generateImageMarker(dictionary, TAG_ID, bits * _BIT_PX)
    sheet = np.pad(tag, round(_QUIET * len(tag)), constant_values=225)
    half = (0.5 + _QUIET) * _SIDE_M
    x = sum(config.workspace.x) / 2
    y0, y1 = config.workspace.y
    y = y0 - _BESIDE_M if config.bin.center[1] > (y0 + y1) / 2 else y1 + _BESIDE_M
    z = config.table.height_m + _THICKNESS_M
    corners = [(x + half, y + half, z), (x + half, y - half, z), (x - half, y - half, z), (x - half, y + half, z)]
    return Visual(
        vertices=np.array(corners, np.float32),
        triangles=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        color=np.array((225, 225, 225), np.uint8),
        kind="table",
        texture=np.asarray(sheet[..., None].repeat(3, axis=2), np.uint8),
    )
