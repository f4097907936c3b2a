from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.solve.closed_form import CLOSED_FORMS
from calibration.solve.consensus import find_consensus
from calibration.solve.se3 import difference, exp, invert
from robotcell.geometry.transforms import check_transform, make_transform
from tests.calibration.synthetic import as_poses, make_views, with_outliers

MOUNTS = pytest.mark.parametrize("mount", ["fixed", "flange"])


@pytest.mark.parametrize("method", CLOSED_FORMS)
@MOUNTS
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_exact_poses_give_the_exact_answer(method: str, mount: str, seed: int) -> None:
    views, truth = make_views(seed, 8, mount=mount)
    poses = as_poses(views, truth)
    X, Z = CLOSED_FORMS[method](poses.T_parent_child, poses.T_camera_board)
    np.testing.assert_allclose(X, truth.X, atol=1e-8)
    np.testing.assert_allclose(Z, truth.Z, atol=1e-8)


@pytest.mark.parametrize("method", CLOSED_FORMS)
def test_nonsense_gives_no_mirrored_camera(method: str) -> None:
    rng = np.random.default_rng(4)
    M, C = (
        np.stack([make_transform(exp(rng.normal(0, 1, 3)), rng.normal(0, 1, 3)) for _ in range(10)]) for _ in range(2)
    )
    X, Z = CLOSED_FORMS[method](M, C)
    check_transform(X, "X")
    check_transform(Z, "Z")


def test_motions_about_one_axis_give_an_answer_that_fits_or_are_refused() -> None:
    angles = np.linspace(-1, 1, 8)
    C = np.stack([make_transform(exp(np.array([0.0, 0.0, a])), (0.1 * a, 0.0, 0.6)) for a in angles])
    for method in ("Park-Martin", "Shah"):
        X, Z = CLOSED_FORMS[method](C, C)
        np.testing.assert_allclose(C @ Z, X @ C, atol=1e-9)
    with pytest.raises(ValueError, match="undetermined"):
        CLOSED_FORMS["Daniilidis"](C, C)


@MOUNTS
@pytest.mark.parametrize("wrong", [4, 12])
def test_a_consensus_ignores_views_that_are_wrong(mount: str, wrong: int) -> None:
    views, truth = make_views(2, 30, mount=mount)
    poses = with_outliers(as_poses(views, truth, position_m=0.0005, rotation_rad=0.0005), np.arange(wrong))
    consensus = find_consensus(poses.T_parent_child, poses.T_camera_board)
    assert np.abs(difference(consensus.X, truth.X)).max() < 0.005
    assert (np.argsort(consensus.disagreement)[:10] >= wrong).all()


def test_a_free_scale_is_found() -> None:
    views, truth = make_views(3, 15)
    poses = as_poses(views, truth)
    seen = poses.T_camera_board.copy()
    seen[:, :3, 3] /= 1.07
    consensus = find_consensus(poses.T_parent_child, seen, free_scale=True)
    assert consensus.scale == pytest.approx(1.07, abs=1e-6)
    np.testing.assert_allclose(consensus.X, truth.X, atol=1e-6)


def test_the_consensus_is_the_same_every_time() -> None:
    views, truth = make_views(5, 20)
    poses = as_poses(views, truth, position_m=0.001, rotation_rad=0.001)
    first, second = (find_consensus(poses.T_parent_child, poses.T_camera_board) for _ in range(2))
    np.testing.assert_array_equal(first.X, second.X)
    np.testing.assert_array_equal(invert(first.Z), invert(second.Z))
