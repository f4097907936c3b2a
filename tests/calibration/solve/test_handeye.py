from __future__ import annotations

import numpy as np
import pytest

from calibration.solve.handeye import jacobian, predict, refine, reject_outliers
from calibration.solve.se3 import change, difference
from calibration.solve.variance_components import pose_noise
from tests.calibration.synthetic import as_poses, make_views, with_outliers

MOUNTS = pytest.mark.parametrize("mount", ["fixed", "flange"])


def noisy(mount: str, count: int = 25, seed: int = 1):
    views, truth = make_views(seed, count, mount=mount)
    poses = as_poses(views, truth, seed=seed, position_m=0.0005, rotation_rad=0.0005)
    return poses.T_parent_child, poses.T_camera_board, truth


@MOUNTS
def test_the_jacobian_is_the_derivative(mount: str) -> None:
    M, _, truth = noisy(mount, 4)
    J = jacobian(truth.X, truth.Z, M)
    h = 1e-6
    for k in range(12):
        delta = np.zeros(12)
        delta[k] = h
        moved = predict(change(truth.X, delta[:6]), change(truth.Z, delta[6:]), M)
        np.testing.assert_allclose(difference(moved, predict(truth.X, truth.Z, M)) / h, J[:, :, k], atol=1e-5)


@MOUNTS
def test_the_noise_is_estimated(mount: str) -> None:
    M, C, truth = noisy(mount, 150)
    fit = refine(truth.X, truth.Z, M, C, pose_noise(C), np.ones(150, bool))
    # Across, along, tilt, roll; synthetic poses are three times worse along and in tilt.
    np.testing.assert_allclose(np.sqrt(fit.variances), (0.0005, 0.0015, 0.0015, 0.0005), rtol=0.2)


@MOUNTS
def test_held_out_is_what_solving_without_the_view_gives(mount: str) -> None:
    M, C, truth = noisy(mount)
    everything = np.ones(25, bool)
    fit = refine(truth.X, truth.Z, M, C, pose_noise(C), everything)
    shift = np.linalg.norm(difference(fit.X_held_out, np.tile(fit.X, (25, 1, 1))), axis=1)
    for i in (int(np.argmax(shift)), 3, 17):
        without = everything.copy()
        without[i] = False
        again = refine(truth.X, truth.Z, M, C, pose_noise(C), without)
        # The variances are estimated again too, hence not the same digits.
        error = np.linalg.norm(difference(fit.X_held_out[i], again.X))
        assert error < 0.25 * shift[i] + 1e-5


@MOUNTS
def test_outliers_are_found_and_the_rest_is_kept(mount: str) -> None:
    views, truth = make_views(6, 40, mount=mount)
    poses = as_poses(views, truth, position_m=0.0005, rotation_rad=0.0005)
    wrong = [3, 4, 11, 25, 39]
    poses = with_outliers(poses, wrong)
    M, C = poses.T_parent_child, poses.T_camera_board
    # One is off by ten standard deviations only.
    C[30, 0, 3] += 0.005
    fit = reject_outliers(truth.X, truth.Z, M, C, pose_noise(C))
    assert np.flatnonzero(~fit.used).tolist() == [3, 4, 11, 25, 30, 39]


def test_a_free_scale_has_a_standard_deviation() -> None:
    M, C, truth = noisy("fixed", 60)
    C[:, :3, 3] /= 1.03
    fit = refine(truth.X, truth.Z, M, C, pose_noise(C), np.ones(60, bool), free_scale=True)
    sigma = np.sqrt(fit.covariance[12, 12])
    assert fit.scale == pytest.approx(1.03, abs=4 * sigma)
    assert 1e-5 < sigma < 2e-3


def test_exact_poses_are_no_trouble() -> None:
    views, truth = make_views(7, 15)
    poses = as_poses(views, truth)
    fit = reject_outliers(
        truth.X, truth.Z, poses.T_parent_child, poses.T_camera_board, pose_noise(poses.T_camera_board)
    )
    assert fit.used.all()
    assert np.isfinite(fit.covariance).all()
    np.testing.assert_allclose(fit.X, truth.X, atol=1e-9)
