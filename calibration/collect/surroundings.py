"""What stands on the table, as the camera saw it before a collection began.

The camera's pose is only a guess then. So it is levelled by the table that it sees, and what it sees is taken to be
larger than it looks. What arm and board hide counts as what the camera does not look at.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.config.surroundings import bin_box
from robotcell.geometry import bodies, ur5e
from robotcell.geometry.transforms import make_transform, transform_points
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.clearance_map import RESOLUTION_M, build_clearance_map

if TYPE_CHECKING:
    from calibration.target.held_board import HeldBoard
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import RgbdFrame
    from robotcell.perception.clearance_map import ClearanceMap

# How far a guessed pose of the camera may shift what it sees: 3 degrees at 0.8 m.
_GUESS_M = 0.04
# Returns within this of where the table should be are taken for the table; then within the second of the plane so far.
_TABLE_M, _PLANE_M = 0.06, 0.015
# Every so many pixels along each side serve to find the table.
_STRIDE = 8
# Around arm and board, the stereo camera has no returns: their shadows at half a metre.
_SHADOW_PX = 31


def what_stands(frame: RgbdFrame, q: Array, held: HeldBoard, T_base_camera: Array, config: CellConfig) -> ClearanceMap:
    """Up to which height something may stand, by a frame that was taken with the arm at joint angles (6,) [rad].

    Args:
        frame: of the fixed camera.
        q: where the arm stood.
        held: the board in its hand.
        T_base_camera: where the camera is thought to stand (4, 4).
        config: of the cell.
    """
    camera = CalibratedCamera(_levelled(frame, T_base_camera, config.table.height_m))
    own = _own_pixels(frame, q, held, camera)
    seen = build_clearance_map(frame, camera, config.table.height_m, (bin_box(config),), own)
    return _without_own(seen.widened(_GUESS_M), np.asarray(transform_points(ur5e.forward(q), held.points), np.float64))


def _without_own(seen: ClearanceMap, board: Array) -> ClearanceMap:
    """The map with nothing where the board (N, 3) [m] itself stood, as far around as the map was widened."""
    lowest = np.full_like(seen.ceiling_m, np.inf)
    rows, cols = seen.ceiling_m.shape
    cells = np.floor((board[:, :2] - seen.origin) / RESOLUTION_M).astype(np.intp)
    inside = ((cells >= 0) & (cells < (cols, rows))).all(axis=1)
    col, row = cells[inside, 0], cells[inside, 1]
    np.minimum.at(lowest, (row, col), (board[inside, 2] - seen.table_height_m - _GUESS_M).astype(np.float32))
    size = 2 * int(np.ceil(_GUESS_M / RESOLUTION_M)) + 1
    around = cv2.erode(lowest, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return replace(seen, ceiling_m=np.asarray(np.minimum(seen.ceiling_m, np.maximum(around, 0.0)), np.float32))


def _levelled(frame: RgbdFrame, T_base_camera: Array, table_height_m: float) -> Array:
    """The pose of the camera turned and lifted so that the table that it sees is level and at its height."""
    camera = CalibratedCamera(T_base_camera)
    rows, cols = frame.depth_m.shape
    part = (slice(0, rows, _STRIDE), slice(0, cols, _STRIDE))
    depth = frame.depth_m[part]
    points = (camera.position[:, None, None] + depth * camera.rays(frame.intrinsics, part))[:, depth > 0]
    near = np.abs(points[2] - table_height_m) < _TABLE_M
    plane = np.array([0.0, 0.0, table_height_m])
    for _ in range(3):
        if np.count_nonzero(near) < points.shape[1] // 10 + 3:
            return T_base_camera
        design = np.column_stack([*points[:2, near], np.ones(np.count_nonzero(near))])
        plane = np.linalg.lstsq(design, points[2, near], rcond=None)[0]
        near = np.abs(points[2] - plane[0] * points[0] - plane[1] * points[1] - plane[2]) < _PLANE_M
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.hypot(1.0, np.hypot(plane[0], plane[1]))
    axis = np.cross(normal, (0.0, 0.0, 1.0))
    R = cv2.Rodrigues(axis)[0]
    return np.asarray(
        make_transform(R, np.array([0.0, 0.0, table_height_m]) - R @ (0.0, 0.0, plane[2])) @ T_base_camera
    )


def _own_pixels(frame: RgbdFrame, q: Array, held: HeldBoard, camera: CalibratedCamera) -> npt.NDArray[np.bool_]:
    """(H, W) pixels that may show arm, gripper or board."""
    own = np.zeros(frame.depth_m.shape, np.uint8)
    u, v, depth = camera.project(bodies.sphere_centers(q), frame.intrinsics).T
    for column, row, at, radius in zip(u, v, depth, bodies.SPHERES.radius, strict=True):
        if at > radius and max(abs(column), abs(row)) < 1e4:
            cv2.circle(own, (round(column), round(row)), round(radius / at * frame.intrinsics.fx) + 1, 1, -1)
    board = camera.project(transform_points(ur5e.forward(q), held.points), frame.intrinsics)
    if (board[:, 2] > 0).all() and np.abs(board[:, :2]).max() < 1e4:
        cv2.fillConvexPoly(own, cv2.convexHull(np.rint(board[:, :2]).astype(np.int32)), 1)
    shadow = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _SHADOW_PX + 1, 2 * _SHADOW_PX + 1))
    return np.asarray(cv2.dilate(own, shadow) > 0)
