"""What stands still in the twin's cell: table, bin, camera and its post, as parts in the base frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from robotcell.config.surroundings import camera_post
from robotcell.geometry.transforms import make_transform
from sim_twin.world.robot_model import Part, Vector

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array

FurnitureKind = Literal["table", "bin", "post"]

_TABLE_COLOR = (92, 90, 86)
_BIN_COLOR = (52, 56, 62)
_POST_COLOR = (150, 152, 155)
_CAMERA_COLOR = (176, 178, 182)
_TABLE_THICKNESS_M = 0.04
_TABLE_MARGIN_M = 0.25
_BIN_WALL_M = 0.008
_BIN_FLOOR_M = 0.003
_POST_M = 0.04
# Intel RealSense D415 data sheet: 99 x 20 x 23 mm; the optical centre lies just behind the front glass.
_D415_M = (0.099, 0.023, 0.020)
_GLASS_M = 0.003


def furniture(config: CellConfig, T_base_camera: Array) -> tuple[tuple[FurnitureKind, Part], ...]:
    """Every standing part with its kind.

    Args:
        config: of the cell.
        T_base_camera: where the camera really stands (4, 4).
    """
    return (
        ("table", _table(config)),
        *(("bin", part) for part in _bin(config)),
        *(("post", part) for part in _camera(config, T_base_camera)),
    )


def _table(config: CellConfig) -> Part:
    """A top that carries the workspace, the bin, the arm's foot and the camera's post."""
    camera = config.camera.pose()[:3, 3]
    (bx, by), (sx, sy) = config.bin.center, config.bin.size
    xs = (*config.workspace.x, bx - sx / 2, bx + sx / 2, 0.0, camera[0])
    ys = (*config.workspace.y, by - sy / 2, by + sy / 2, 0.0, camera[1])
    top = config.table.height_m
    return _block(
        (min(xs) - _TABLE_MARGIN_M, min(ys) - _TABLE_MARGIN_M, top - _TABLE_THICKNESS_M),
        (max(xs) + _TABLE_MARGIN_M, max(ys) + _TABLE_MARGIN_M, top),
        _TABLE_COLOR,
    )


def _bin(config: CellConfig) -> list[Part]:
    """Floor and four walls; the configured size is the outer one."""
    (x, y), (sx, sy) = config.bin.center, config.bin.size
    low, high = config.table.height_m, config.table.height_m + config.bin.wall_height_m
    x0, x1, y0, y1, w = x - sx / 2, x + sx / 2, y - sy / 2, y + sy / 2, _BIN_WALL_M
    return [
        _block((x0, y0, low), (x1, y1, low + _BIN_FLOOR_M), _BIN_COLOR),
        _block((x0, y0, low), (x0 + w, y1, high), _BIN_COLOR),
        _block((x1 - w, y0, low), (x1, y1, high), _BIN_COLOR),
        _block((x0 + w, y0, low), (x1 - w, y0 + w, high), _BIN_COLOR),
        _block((x0 + w, y1 - w, low), (x1 - w, y1, high), _BIN_COLOR),
    ]


def _camera(config: CellConfig, T_base_camera: Array) -> list[Part]:
    """The housing behind the optical centre, and the post where the safety layer expects it."""
    housing = T_base_camera @ make_transform(np.eye(3), (0.0, 0.0, -_GLASS_M - _D415_M[2] / 2))
    parts = [Part("box", _D415_M, housing, _CAMERA_COLOR)]
    post = camera_post(config)
    if post is not None:
        x, y, half = sum(post.x) / 2, sum(post.y) / 2, _POST_M / 2
        parts.append(_block((x - half, y - half, post.z[0]), (x + half, y + half, post.z[1]), _POST_COLOR))
    return parts


def _block(low: Vector, high: Vector, color: tuple[int, int, int]) -> Part:
    a, b = np.array(low), np.array(high)
    x, y, z = b - a
    return Part("box", (x, y, z), make_transform(np.eye(3), (a + b) / 2), color)
