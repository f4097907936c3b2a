from __future__ import annotations

import numpy as np
import pytest

from calibration.solve.bundle_adjustment import BundleNoise, solve_bundle
from calibration.solve.projection import intrinsics_vector, stack_corners
from calibration.solve.se3 import change, difference
from robotcell.geometry.transforms import make_transform
from tests.calibration.synthetic import BOARD, CAMERA, make_views

MOUNTS = pytest.mark.parametrize("mount", ["fixed", "flange"])
NOISE = BundleNoise(0.2, 0.0002, 0.0003)
START = np.array([0.004, -0.003, 0.002, 0.004, 0.003, -0.005])


def setup(mount: str, count: int = 15, seed: int = 0, noise: BundleNoise | None = NOISE, camera=CAMERA):
    px, m, rad = (noise.corner_px, noise.position_m, noise.rotation_rad) if noise else (0.0, 0.0, 0.0)
    views, truth = make_views(seed, count, mount=mount, corner_px=px, position_m=m, rotation_rad=rad, camera=camera)
    stack = stack_corners(views.corners, BOARD.corners())
    return stack, views.T_parent_child, truth.X, truth.Z @ make_transform(np.eye(3), stack.center)


@MOUNTS
def test_exact_corners_give_the_exact_answer(mount: str) -> None:
    stack, M, X, Z = setup(mount, noise=None)
    found = solve_bundle(
        stack, M, NOISE, change(X, START), change(Z, -START), intrinsics_vector(CAMERA), on_the_arm=mount == "fixed"
    )
    np.testing.assert_allclose(found.X, X, atol=1e-8)
    np.testing.assert_allclose(found.Z, Z, atol=1e-8)
    assert np.abs(found.arm).max() < 1e-8


@MOUNTS
@pytest.mark.parametrize("width", [None, CAMERA.width])
def test_held_out_is_what_solving_without_the_view_gives(mount: str, width: int | None) -> None:
    stack, M, X, Z = setup(mount)
    intrinsics, on_the_arm = intrinsics_vector(CAMERA), mount == "fixed"
    whole = solve_bundle(stack, M, NOISE, X, Z, intrinsics, on_the_arm=on_the_arm, width=width)
    shifts = np.linalg.norm(difference(whole.X_held_out, np.tile(whole.X, (15, 1, 1))), axis=1)
    for i in (0, 6, int(np.argmax(shifts))):
        others = np.delete(np.arange(15), i)
        again = solve_bundle(
            stack.subset(others), M[others], NOISE, X, Z, intrinsics, on_the_arm=on_the_arm, width=width
        )
        # A step is exact for a linear problem; distortion is the least linear.
        share = 0.05 if width is None else 0.2
        assert np.linalg.norm(difference(whole.X_held_out[i], again.X)) < share * shifts[i] + 1e-6


@MOUNTS
def test_the_arms_errors_are_not_put_on_the_camera(mount: str) -> None:
    """With a loud arm and quiet corners the bundle must not follow each pose; its covariance says what is left."""
    loud = BundleNoise(0.05, 0.001, 0.001)
    stack, M, X, Z = setup(mount, 40, noise=loud)
    found = solve_bundle(stack, M, loud, X, Z, intrinsics_vector(CAMERA), on_the_arm=mount == "fixed")
    e = difference(found.X, X)
    assert e @ np.linalg.solve(found.covariance, e) < 25
    np.testing.assert_allclose(found.arm[:, :3].std(), 0.001, rtol=0.3)


def test_refined_intrinsics_are_those_of_the_lens() -> None:
    lens = CAMERA.model_copy(update={"fx": 915.0, "fy": 917.0, "cx": 652.0, "cy": 351.0, "dist": (0.08, -0.1)})
    lens = lens.model_copy(update={"dist": (0.08, -0.1, 0.001, -0.0005, 0.0)})
    stack, M, X, Z = setup("fixed", 40, noise=BundleNoise(0.1, 1e-6, 1e-6), camera=lens)
    found = solve_bundle(
        stack,
        M,
        BundleNoise(0.1, 1e-5, 1e-5),
        X,
        Z,
        intrinsics_vector(CAMERA),
        on_the_arm=True,
        width=CAMERA.width,
    )
    np.testing.assert_allclose(found.intrinsics[:4], intrinsics_vector(lens)[:4], atol=1.5)
    assert found.intrinsics[4] == pytest.approx(0.08, abs=0.02)
    assert np.linalg.norm(difference(found.X, X)[:3]) < 0.002


def test_a_view_that_the_arm_got_wrong_is_held_back() -> None:
    stack, M, X, Z = setup("fixed", 30)
    clean = solve_bundle(stack, M, NOISE, X, Z, intrinsics_vector(CAMERA), on_the_arm=True)
    M[4] = change(M[4], np.array([0.003, 0.0, 0.0, 0.0, 0.0, 0.0]))
    spoiled = solve_bundle(stack, M, NOISE, X, Z, intrinsics_vector(CAMERA), on_the_arm=True)
    # The view has one vote of thirty: 0.1 mm if it were believed.
    assert np.linalg.norm(difference(spoiled.X, clean.X)[:3]) < 0.00008
