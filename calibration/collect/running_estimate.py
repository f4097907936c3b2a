"""Where camera and board are by the views so far: in closed form, while the collection goes on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.board_pose import refine_poses, start_poses, usable_corners
from calibration.solve.consensus import find_consensus
from calibration.solve.projection import intrinsics_vector, stack_corners
from robotcell.geometry.transforms import Array, make_transform

if TYPE_CHECKING:
    from calibration.solve.views import Views

# Before these, an estimate says nothing.
_ESTIMATE_VIEWS = 5


@dataclass(frozen=True)
class RunningEstimate:
    """What the views so far say.

    Attributes:
        T_base_camera: (4, 4).
        T_flange_board: (4, 4).
        disagreement_m: by which the median view disagrees, turns at a lever counted in.
    """

    T_base_camera: Array
    T_flange_board: Array
    disagreement_m: float


def running_estimate(views: Views) -> RunningEstimate | None:
    """What the views so far say, in closed form; None where they are too few."""
    if views.corners is None or views.board is None or views.camera is None or not len(views):
        return None
    stack, intrinsics = stack_corners(views.corners, views.board.corners()), intrinsics_vector(views.camera)
    index = np.flatnonzero(usable_corners(stack))
    if len(index) < _ESTIMATE_VIEWS:
        return None
    stack = stack.subset(index)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    found = find_consensus(views.T_parent_child[index], poses.T_camera_board)
    return RunningEstimate(found.X, found.Z @ make_transform(np.eye(3), -stack.center), found.score)
