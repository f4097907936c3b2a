"""What stands around the arm by the cell's own file: keep-outs, the bin, the camera and its post."""

from __future__ import annotations

import numpy as np

from robotcell.config.schema import CellConfig, KeepOut

# The camera's housing and its post stand behind its optical centre.
_CAMERA_M = 0.12
_POST_M = 0.06
# A camera that looks straighter down than this hangs from above: a post would stand in its view.
_HANGING_SLOPE = 0.1


def obstacles(config: CellConfig) -> tuple[KeepOut, ...]:
    """Everything that arm and gripper must not enter: the keep-outs of the file, the bin, the camera and its post."""
    x, y, z = config.camera.pose()[:3, 3]
    camera = _box("camera", (x, y, z), (_CAMERA_M, _CAMERA_M, _CAMERA_M))
    post = camera_post(config)
    return (*config.keep_out, bin_box(config), camera, *((post,) if post else ()))


def bin_box(config: CellConfig) -> KeepOut:
    """The bin with all that is in it."""
    (x, y), (length, width), height = config.bin.center, config.bin.size, config.bin.wall_height_m
    return _box("bin", (x, y, config.table.height_m + height / 2), (length, width, height))


def camera_post(config: CellConfig) -> KeepOut | None:
    """The post that carries the camera, on the side that it does not look at; None for one that hangs from above."""
    T = config.camera.pose()
    x, y, z = T[:3, 3]
    slope = float(np.linalg.norm(T[:2, 2]))
    if slope < _HANGING_SLOPE:
        return None
    px, py = np.array([x, y]) - (_CAMERA_M + _POST_M) / 2 * T[:2, 2] / slope
    low, high = config.table.height_m, z + _CAMERA_M / 2
    return _box("camera post", (px, py, (low + high) / 2), (_POST_M, _POST_M, max(high - low, _POST_M)))


def _box(name: str, center: tuple[float, float, float], size: tuple[float, float, float]) -> KeepOut:
    x, y, z = ((c - s / 2, c + s / 2) for c, s in zip(center, size, strict=True))
    return KeepOut(name=name, x=x, y=y, z=z)
