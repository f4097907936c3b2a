"""Made-up calibrations whose answer is known: both mounts, corners or poses, with noise of corners and arm."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.solve.projection import intrinsics_vector, project
from calibration.solve.se3 import change, exp, invert
from calibration.solve.views import Corners, Views
from robotcell.config.calibration_file import CameraModel, CharucoBoard, Mount
from robotcell.geometry.transforms import look_at, make_transform

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

DATE = datetime(2026, 3, 1, 12, 0, tzinfo=timezone.utc)
CAMERA = CameraModel(serial="018322070101", width=1280, height=720, fx=926.0, fy=926.0, cx=640.0, cy=360.0)
BOARD = CharucoBoard(squares_x=7, squares_y=5, square_m=0.04, marker_m=0.03, dictionary="DICT_5X5_100")
_SAMPLE = 200


@dataclass(frozen=True)
class Truth:
    """The answer: X = T_parent_camera and Z = T_child_board."""

    X: Array
    Z: Array


def make_views(
    seed: int,
    count: int = 20,
    *,
    mount: Mount = "fixed",
    corner_px: float = 0.0,
    position_m: float = 0.0,
    rotation_rad: float = 0.0,
    tilt_rad: float = 0.6,
    camera: CameraModel = CAMERA,
    board: CharucoBoard = BOARD,
) -> tuple[Views, Truth]:
    """Views of a board all over the picture, and the answer.

    Args:
        seed: of everything random.
        count: views.
        mount: where the camera is.
        corner_px: standard deviation of a corner's coordinate [px].
        position_m: of the flange's position as the arm states it [m].
        rotation_rad: of its rotation [rad].
        tilt_rad: how far the board turns away from facing the camera, about all axes.
        camera: with its true intrinsics.
        board: that is seen.
    """
    rng = np.random.default_rng(seed)
    facing = np.diag([1.0, 1.0, 1.0])
    center = np.mean(list(board.corners().values()), axis=0)
    if mount == "fixed":
        X = look_at((-0.8, 0.0, 0.8), (-0.5, 0.0, 0.0)) @ make_transform(exp(rng.normal(0, 0.1, 3)), np.zeros(3))
        Z = make_transform(exp(rng.normal(0, 0.3, 3)), (0.05, -0.03, 0.06))
    else:
        X = make_transform(exp(np.array([0.1, -0.2, 1.5])), (0.03, 0.06, 0.05))
        Z = make_transform(exp(rng.normal(0, 0.2, 3)), (-0.5, 0.1, 0.02))
    points = np.array(list(board.corners().values()))
    C = []
    while len(C) < count:
        tilt = rng.uniform(-tilt_rad, tilt_rad, 3)
        distance = rng.uniform(0.45, 0.9)
        px = rng.uniform((0.2, 0.2), (0.8, 0.8)) * (camera.width, camera.height)
        ray = np.array([(px[0] - camera.cx) / camera.fx, (px[1] - camera.cy) / camera.fy, 1.0])
        T = make_transform(exp(tilt) @ facing, ray * distance)
        T[:3, 3] -= T[:3, :3] @ center
        seen = project(points @ T[:3, :3].T + T[:3, 3], intrinsics_vector(camera), derivatives=False)[0]
        inside = (seen > 5).all(axis=1) & (seen < (camera.width - 5, camera.height - 5)).all(axis=1)
        if inside.sum() >= 8:
            C.append(T)
    T_camera_board = np.stack(C)
    M = X @ T_camera_board @ invert(Z)
    flange = M if mount == "fixed" else invert(M)
    corners = []
    for T in T_camera_board:
        seen = project(points @ T[:3, :3].T + T[:3, 3], intrinsics_vector(camera), derivatives=False)[0]
        inside = (seen > 5).all(axis=1) & (seen < (camera.width - 5, camera.height - 5)).all(axis=1)
        noisy = seen[inside] + rng.normal(0, corner_px, (inside.sum(), 2))
        corners.append(Corners(np.flatnonzero(inside), noisy))
    off = np.concatenate([rng.normal(0, position_m, (count, 3)), rng.normal(0, rotation_rad, (count, 3))], axis=1)
    stated = flange @ change(np.tile(np.eye(4), (count, 1, 1)), off)
    names = tuple(f"view_{i:03d}" for i in range(count))
    return Views(mount, names, stated, DATE, None, tuple(corners), camera, board), Truth(X, Z)


def as_poses(views: Views, truth: Truth, *, seed: int = 0, position_m: float = 0.0, rotation_rad: float = 0.0) -> Views:
    """The same views as poses of the board, with noise of their own: three times as much along the axis and in tilt."""
    rng = np.random.default_rng(seed)
    count = len(views)
    spread = np.array([position_m, position_m, 3 * position_m, 3 * rotation_rad, 3 * rotation_rad, rotation_rad])
    seen = change(invert(truth.X) @ views.T_parent_child @ truth.Z, rng.normal(0, 1, (count, 6)) * spread)
    return Views(views.mount, views.names, views.T_base_flange, views.date, seen)


def with_outliers(poses: Views, indices: npt.ArrayLike, seed: int = 0) -> Views:
    """Poses of which some have nothing to do with the arm's."""
    rng = np.random.default_rng(seed)
    assert poses.T_camera_board is not None
    seen = poses.T_camera_board.copy()
    for i in np.atleast_1d(indices):
        seen[i] = make_transform(exp(rng.normal(0, 1, 3)), rng.uniform((-0.3, -0.3, 0.4), (0.3, 0.3, 1.2)))
    return Views(poses.mount, poses.names, poses.T_base_flange, poses.date, seen)


def to_json(matrix: Any) -> Any:
    """Nested lists of an array."""
    return np.asarray(matrix).tolist()
