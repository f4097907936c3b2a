"""What is left of the corners once the solution is taken away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.projection import intrinsics_vector, project
from calibration.solve.se3 import invert
from robotcell.geometry.transforms import transform_points

if TYPE_CHECKING:
    from calibration.solve.solution import Solution
    from robotcell.geometry.transforms import Array


@dataclass(frozen=True)
class Residual:
    """The corners of one view, as seen and as the arm carries them.

    Attributes:
        px: (n, 2) seen.
        off_px: (n, 2) seen minus carried.
    """

    px: Array
    off_px: Array


def reprojection_residuals(solution: Solution) -> dict[str, Residual]:
    """What is left of each view, by name; empty without corners or a result."""
    views, estimate = solution.views, solution.estimate
    if views.corners is None or views.board is None or estimate is None or estimate.camera is None:
        return {}
    board, optics = views.board.corners(), intrinsics_vector(estimate.camera)
    found = {}
    for name, M, corners in zip(views.names, views.T_parent_child, views.corners, strict=True):
        points = np.array([board[int(i)] for i in corners.ids]).reshape(-1, 3)
        T_camera_board = invert(estimate.X) @ M @ estimate.Z
        px, _, _ = project(np.asarray(transform_points(T_camera_board, points), np.float64), optics, derivatives=False)
        found[name] = Residual(corners.px, corners.px - px)
    return found


def board_poses(solution: Solution) -> Array:
    """T_camera_board (V, 4, 4) of all views: as given, or as the result has them; empty without either."""
    views, estimate = solution.views, solution.estimate
    if estimate is not None:
        return np.asarray(invert(estimate.X) @ views.T_parent_child @ estimate.Z)
    return np.zeros((0, 4, 4)) if views.T_camera_board is None else views.T_camera_board
