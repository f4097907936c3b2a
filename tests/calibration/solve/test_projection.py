from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.solve.board_pose import (
    refine_poses,
    settle_ambiguity,
    start_poses,
    usable_corners,
    without_false_corners,
)
from calibration.solve.projection import CornerStack, intrinsics_vector, project, stack_corners
from calibration.solve.se3 import change, difference, invert
from calibration.solve.views import Corners
from robotcell.config.calibration_file import PointBoard
from robotcell.geometry.transforms import make_transform
from tests.calibration.synthetic import BOARD, CAMERA, make_views

INTRINSICS = np.array([926.0, 924.0, 640.0, 355.0, 0.1, -0.2, 0.001, -0.002, 0.05])
coordinate = st.floats(-0.3, 0.3)
point = st.tuples(coordinate, coordinate, st.floats(0.4, 1.5)).map(np.array)


@given(point)
def test_projection_is_that_of_opencv(p: np.ndarray) -> None:
    camera = np.array([[926.0, 0, 640], [0, 924, 355], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(p.reshape(1, 3), np.zeros(3), np.zeros(3), camera, INTRINSICS[4:])
    np.testing.assert_allclose(project(p, INTRINSICS)[0], theirs.ravel(), atol=1e-8)


@given(point)
def test_derivatives_are_those_of_the_projection(p: np.ndarray) -> None:
    _, by_point, by_intrinsics = project(p, INTRINSICS)
    for k in range(3):
        h = 1e-6 * np.eye(3)[k]
        numeric = (project(p + h, INTRINSICS)[0] - project(p - h, INTRINSICS)[0]) / 2e-6
        np.testing.assert_allclose(by_point[:, k], numeric, rtol=1e-5, atol=1e-3)
    for k in range(9):
        h = 1e-6 * np.eye(9)[k]
        numeric = (project(p, INTRINSICS + h)[0] - project(p, INTRINSICS - h)[0]) / 2e-6
        np.testing.assert_allclose(by_intrinsics[:, k], numeric, rtol=1e-5, atol=1e-4)


def test_exact_corners_give_the_exact_pose() -> None:
    views, truth = make_views(0, 10)
    stack, intrinsics = stack_corners(views.corners, BOARD.corners()), intrinsics_vector(CAMERA)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    T = invert(truth.X) @ views.T_parent_child @ truth.Z @ make_transform(np.eye(3), stack.center)
    np.testing.assert_allclose(poses.T_camera_board, T, atol=1e-7)


def test_the_pose_is_as_sure_as_it_says() -> None:
    squared = []
    for seed in range(30):
        views, truth = make_views(seed, 10, corner_px=0.3)
        stack, intrinsics = stack_corners(views.corners, BOARD.corners()), intrinsics_vector(CAMERA)
        poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
        T = invert(truth.X) @ views.T_parent_child @ truth.Z @ make_transform(np.eye(3), stack.center)
        e = difference(poses.T_camera_board, T)
        squared.append(np.einsum("vi,vij,vj->v", e, poses.information / poses.sigma_px**2, e).mean() / 6)
        assert poses.sigma_px == pytest.approx(0.3, rel=0.15)
    assert np.mean(squared) == pytest.approx(1.0, rel=0.1)


def test_a_false_corner_is_left_out() -> None:
    views, _ = make_views(1, 10, corner_px=0.1)
    stack, intrinsics = stack_corners(views.corners, BOARD.corners()), intrinsics_vector(CAMERA)
    clean = refine_poses(stack, intrinsics, start_poses(stack, intrinsics)).T_camera_board
    px = stack.px.copy()
    px[:, 4] += (25.0, -15.0)
    spoiled = CornerStack(stack.points, px, stack.seen, stack.center)
    poses = refine_poses(spoiled, intrinsics, start_poses(spoiled, intrinsics))
    assert poses.sigma_px < 0.3
    kept = without_false_corners(spoiled, intrinsics, poses)
    assert not kept.seen[:, 4].any()
    assert kept.counts.sum() > 0.99 * (stack.counts - 1).sum()
    found = refine_poses(kept, intrinsics, poses.T_camera_board).T_camera_board
    assert np.abs(difference(found, clean)).max() < 0.001


def test_the_flipped_pose_of_a_flat_board_is_put_right() -> None:
    views, truth = make_views(3, 12, corner_px=0.05)
    stack, intrinsics = stack_corners(views.corners, BOARD.corners()), intrinsics_vector(CAMERA)
    T = invert(truth.X) @ views.T_parent_child @ truth.Z @ make_transform(np.eye(3), stack.center)
    flipped = change(T, np.tile([0.0, 0.0, 0.0, 0.5, -0.4, 0.0], (12, 1)))
    poses = refine_poses(stack, intrinsics, flipped)
    settled = settle_ambiguity(stack, intrinsics, poses, change(T, np.full((12, 6), 0.01)))
    assert np.abs(difference(settled.T_camera_board, T)).max() < 0.01


def test_too_few_corners_and_corners_on_a_line_are_unusable() -> None:
    views, _ = make_views(0, 3)
    full = views.corners[0]
    few = Corners(full.ids[:5], full.px[:5])
    line = Corners(np.arange(6), np.column_stack([np.arange(6) * 40.0, np.full(6, 200.0)]))
    dot = Corners(full.ids, np.full_like(full.px, 300.0))
    stack = stack_corners((full, few, line, dot), BOARD.corners())
    assert usable_corners(stack).tolist() == [True, False, False, False]


def test_points_off_a_plane_have_a_pose_too() -> None:
    rng = np.random.default_rng(0)
    board = PointBoard(points={i: tuple(rng.uniform(-0.1, 0.1, 3).tolist()) for i in range(12)})
    T = make_transform(np.eye(3), (0.05, -0.02, 0.7))
    points = np.array(list(board.corners().values()))
    px, _, _ = project(points + T[:3, 3], intrinsics_vector(CAMERA), derivatives=False)
    stack, intrinsics = stack_corners((Corners(np.arange(12), px),), board.corners()), intrinsics_vector(CAMERA)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    np.testing.assert_allclose(poses.T_camera_board[0, :3, 3], T[:3, 3] + stack.center, atol=1e-7)
