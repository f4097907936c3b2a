"""What the camera saw of the board: its pose in every view, and the corners behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.board_pose import BoardPoses, refine_poses, settle_ambiguity, start_poses, without_false_corners
from calibration.solve.consensus import LEVER, find_consensus
from calibration.solve.handeye import predict
from calibration.solve.projection import CornerStack, intrinsics_vector, stack_corners

if TYPE_CHECKING:
    from calibration.solve.views import Views
    from robotcell.geometry.transforms import Array


@dataclass(frozen=True)
class BoardObservations:
    """Poses of the board in front of the camera, and the corners behind them where there are any.

    Attributes:
        T_camera_board: (V, 4, 4); with corners the board's origin is the mean of its corners.
        poses: the same with their information; None without corners.
        stack: the corners; None without.
        intrinsics: (9,) with which they were turned into poses; None without.
    """

    T_camera_board: Array
    poses: BoardPoses | None = None
    stack: CornerStack | None = None
    intrinsics: Array | None = None

    @property
    def lever_m(self) -> float:
        """The distance [m] at which a turn counts."""
        return LEVER * float(np.median(np.linalg.norm(self.T_camera_board[:, :3, 3], axis=1)))


def observe_board(views: Views) -> BoardObservations:
    """The board's poses as the camera saw them."""
    if views.corners is None or views.board is None or views.camera is None:
        assert views.T_camera_board is not None
        return BoardObservations(views.T_camera_board)
    stack = stack_corners(views.corners, views.board.corners())
    intrinsics = intrinsics_vector(views.camera)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    expected = find_consensus(views.T_parent_child, poses.T_camera_board, free_scale=True)
    T_expected = predict(expected.X, expected.Z, views.T_parent_child)
    T_expected[:, :3, 3] /= expected.scale
    poses = settle_ambiguity(stack, intrinsics, poses, T_expected)
    stack = without_false_corners(stack, intrinsics, poses)
    return observations(stack, intrinsics, refine_poses(stack, intrinsics, poses.T_camera_board))


def observations(stack: CornerStack, intrinsics: Array, poses: BoardPoses) -> BoardObservations:
    """The observations that poses of the board from its corners are."""
    return BoardObservations(poses.T_camera_board, poses, stack, intrinsics)
