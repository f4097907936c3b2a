from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibration.solve.depth_correction import fit_depth
from calibration.solve.pipeline import solve
from calibration.solve.readers.view_file import read_file
from calibration.solve.se3 import difference, exp, invert
from calibration.solve.verdict import Reason
from calibration.solve.views import Corners, Views
from robotcell.geometry.transforms import make_transform, rotation_angle
from tests.calibration.synthetic import BOARD, CAMERA, as_poses, make_views, with_outliers

if TYPE_CHECKING:
    from calibration.solve.solution import Solution

MOUNTS = pytest.mark.parametrize("mount", ["fixed", "flange"])
QUIET = {"corner_px": 0.2, "position_m": 0.0002, "rotation_rad": 0.0003}
MOVEIT = Path(__file__).parents[1] / "data" / "moveit_pose_samples.json"


def error(solution: Solution, truth) -> tuple[float, float]:
    """[mm] and [degrees]."""
    e = difference(solution.estimate.X, truth.X)
    return 1e3 * float(np.linalg.norm(e[:3])), float(np.rad2deg(np.linalg.norm(e[3:])))


def poses_of(seed: int, count: int = 20, mount: str = "fixed") -> Views:
    views, truth = make_views(seed, count, mount=mount)
    return as_poses(views, truth, seed=seed, position_m=0.0003, rotation_rad=0.0005)


@pytest.mark.parametrize(("mount", "seed"), [("fixed", 0), ("fixed", 1), ("flange", 2), ("flange", 3)])
def test_corners_give_camera_and_board(mount: str, seed: int) -> None:
    views, truth = make_views(seed, mount=mount, **QUIET)
    solution = solve(views)
    assert solution.accepted
    mm, deg = error(solution, truth)
    assert mm < 1.0
    assert deg < 0.1
    assert np.linalg.norm(difference(solution.estimate.Z, truth.Z)[:3]) < 0.001
    assert solution.spread("px").median < 1.0
    assert solution.rejected == ()


@MOUNTS
def test_poses_give_camera_and_board(mount: str) -> None:
    views, truth = make_views(4, mount=mount)
    solution = solve(as_poses(views, truth, position_m=0.0003, rotation_rad=0.0005))
    assert solution.accepted
    mm, deg = error(solution, truth)
    assert mm < 1.5
    assert deg < 0.1
    assert solution.spread("px") is None
    assert solution.estimate.scale == pytest.approx(1.0, abs=4 * solution.estimate.scale_sigma)


def test_the_public_pairs_give_the_published_answer() -> None:
    solution = solve(read_file(MOVEIT))
    assert solution.accepted
    X = solution.estimate.X
    assert np.linalg.norm(X[:3, 3] - (0.659, -0.249, 0.830)) < 0.01
    published = Rotation.from_euler("XYZ", (0.230, -2.540, 1.950)).as_matrix()
    assert np.rad2deg(rotation_angle(X[:3, :3], published)) < 1.0


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_among_the_public_pairs_are_named_and_change_nothing(share: float) -> None:
    clean = read_file(MOVEIT)
    wrong = np.random.default_rng(1).choice(50, round(50 * share), replace=False)
    before, after = solve(clean), solve(with_outliers(clean, wrong))
    assert after.accepted
    assert set(after.rejected) == {clean.names[i] for i in wrong}
    for unit in ("mm", "deg"):
        assert after.spread(unit).median == pytest.approx(before.spread(unit).median, rel=0.1)


@pytest.mark.parametrize(("mount", "seed"), [("fixed", 0), ("flange", 1)])
def test_outliers_added_to_corners_change_nothing(mount: str, seed: int) -> None:
    views, _ = make_views(seed, 40, mount=mount, **QUIET)
    before = solve(views)
    others, _ = make_views(seed + 50, 4, mount=mount)
    both = replace(
        views,
        names=(*views.names, "w0", "w1", "w2", "w3"),
        T_base_flange=np.concatenate([views.T_base_flange, views.T_base_flange[:4]]),
        corners=(*views.corners, *others.corners),
    )
    after = solve(both)
    assert set(after.rejected) - set(before.rejected) == {"w0", "w1", "w2", "w3"}
    for unit in ("mm", "deg", "px"):
        assert after.spread(unit).median == pytest.approx(before.spread(unit).median, rel=0.1)


def test_the_stated_covariance_is_true() -> None:
    """A short form of tests/benchmarks/calibration_coverage.py, with bounds that a true covariance misses never."""
    inside = []
    for seed in range(24):
        views, truth = make_views(seed, 16, **QUIET)
        estimate = solve(views).estimate
        e = difference(estimate.X, truth.X)
        inside.append(e @ np.linalg.solve(estimate.covariance, e))
    inside = np.array(inside)
    # Binomial, 24 draws: fewer or more than this happens once in a thousand.
    assert 8 <= (inside < chi2.ppf(0.68, 6)).sum() <= 23
    assert (inside < chi2.ppf(0.95, 6)).sum() >= 18


def test_a_quieter_set_is_surer() -> None:
    quiet, loud = (
        solve(make_views(3, corner_px=px, position_m=m, rotation_rad=m)[0]).estimate.covariance
        for px, m in ((0.1, 0.0001), (0.4, 0.0005))
    )
    assert np.linalg.slogdet(quiet)[1] < np.linalg.slogdet(loud)[1] - 6


def test_views_with_few_corners_are_left_out_by_name() -> None:
    views, truth = make_views(1, 20, **QUIET)
    few = Corners(views.corners[5].ids[:4], views.corners[5].px[:4])
    none = Corners(np.empty(0, np.int64), np.empty((0, 2)))
    solution = solve(replace(views, corners=(*views.corners[:5], few, none, *views.corners[7:])))
    assert solution.accepted
    assert solution.rejected == ("view_005", "view_006")
    assert [view.why for view in solution.errors[5:7]] == ["4 corners; 6 are needed", "0 corners; 6 are needed"]
    assert error(solution, truth)[0] < 1.0


def test_wrong_intrinsics_are_refused_and_refined_on_request() -> None:
    views, truth = make_views(3, 30, **QUIET)
    wrong = CAMERA.model_copy(update={"fx": CAMERA.fx * 1.02, "fy": CAMERA.fy * 1.02, "cx": 650.0})
    refused = solve(replace(views, camera=wrong))
    assert refused.verdict.reason is Reason.WRONG_INTRINSICS
    assert "--refine-intrinsics" in refused.verdict.cure
    solution = solve(replace(views, camera=wrong), refine_intrinsics=True)
    assert solution.accepted
    assert solution.estimate.intrinsics_refined
    assert solution.estimate.camera.fx == pytest.approx(CAMERA.fx, rel=0.003)
    assert error(solution, truth)[0] < 1.5


def test_intrinsics_cannot_be_refined_from_poses() -> None:
    with pytest.raises(ValueError, match="only be refined from corners"):
        solve(poses_of(0), refine_intrinsics=True)


def test_depth_scale_and_offset_come_from_the_board() -> None:
    views, truth = make_views(2, 20, **QUIET)
    rng = np.random.default_rng(0)
    points = np.array(list(BOARD.corners().values()))
    corners = []
    for view, M in zip(views.corners, views.T_parent_child, strict=True):
        T = invert(truth.X) @ M @ truth.Z
        z = points[view.ids] @ T[2, :3] + T[2, 3]
        measured = (z - 0.004) / 1.01 + rng.normal(0, 0.001, len(z)) * z**2
        measured[rng.random(len(z)) < 0.1] = 0.0
        corners.append(replace(view, depth_m=measured))
    depth = solve(replace(views, corners=tuple(corners))).estimate.depth
    assert depth.scale == pytest.approx(1.01, abs=0.004)
    assert depth.scale * 0.65 + depth.offset_m == pytest.approx(1.01 * 0.65 + 0.004, abs=0.0005)
    assert depth.rms_after_m < 0.3 * depth.rms_before_m


def test_depth_of_a_few_pixels_is_no_measurement() -> None:
    assert fit_depth(np.full(100, 0.0), np.full(100, 0.7)) is None


def assert_refused(views: Views, reason: Reason, words: str = "") -> None:
    solution = solve(views)
    assert solution.verdict.reason is reason, solution.verdict.words
    assert words in solution.verdict.words
    assert solution.verdict.cure
    report = solution.as_json()
    assert report["verdict"]["accepted"] is False
    assert report["T_base_camera" if views.mount == "fixed" else "T_flange_camera"] is None


@MOUNTS
class TestRefusals:
    def test_eleven_views(self, mount: str) -> None:
        assert_refused(poses_of(0, 11, mount), Reason.TOO_FEW_VIEWS, "11 of 11")

    def test_twelve_views_are_enough(self, mount: str) -> None:
        assert solve(poses_of(0, 12, mount)).accepted

    def test_eleven_views_that_agree_and_three_that_do_not(self, mount: str) -> None:
        assert_refused(with_outliers(poses_of(0, 14, mount), [1, 5, 9]), Reason.TOO_FEW_VIEWS, "11 of 14")

    def test_too_little_rotation(self, mount: str) -> None:
        views, _ = make_views(0, 20, mount=mount, tilt_rad=0.03, corner_px=0.1)
        assert_refused(views, Reason.TOO_LITTLE_ROTATION)

    def test_parallel_axes(self, mount: str) -> None:
        poses = poses_of(0, 20, mount)
        _, truth = make_views(0, 20, mount=mount)
        rng = np.random.default_rng(0)
        seen = np.stack(
            [
                make_transform(exp(np.array([0, 0, a])), (*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.5, 0.9)))
                for a in rng.uniform(-1.5, 1.5, 20)
            ]
        )
        M = truth.X @ seen @ invert(truth.Z)
        one_axis = replace(poses, T_base_flange=M if mount == "fixed" else invert(M), T_camera_board=seen)
        assert_refused(one_axis, Reason.TOO_LITTLE_ROTATION, "parallel")

    def test_left_handed_matrices(self, mount: str) -> None:
        poses = poses_of(0, 20, mount)
        mirrored = np.diag([1.0, -1.0, 1.0, 1.0]) @ poses.T_camera_board
        assert_refused(replace(poses, T_camera_board=mirrored), Reason.MIRRORED, "determinant -1")

    def test_mirrored_poses_of_determinant_one(self, mount: str) -> None:
        poses = poses_of(0, 20, mount)
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        assert_refused(replace(poses, T_camera_board=mirror @ poses.T_camera_board @ mirror), Reason.MIRRORED)

    def test_mirrored_images(self, mount: str) -> None:
        views, _ = make_views(0, 20, mount=mount, **QUIET)
        flipped = tuple(replace(view, px=view.px * (-1, 1) + (CAMERA.width - 1, 0)) for view in views.corners)
        assert_refused(replace(views, corners=flipped), Reason.MIRRORED)

    def test_inverted_board_poses(self, mount: str) -> None:
        poses = poses_of(0, 20, mount)
        assert_refused(replace(poses, T_camera_board=invert(poses.T_camera_board)), Reason.INVERTED_POSES)

    @pytest.mark.parametrize("side", ["T_camera_board", "T_base_flange"])
    def test_transposed_rotations(self, mount: str, side: str) -> None:
        poses = poses_of(0, 20, mount)
        T = getattr(poses, side).copy()
        T[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
        assert_refused(replace(poses, **{side: T}), Reason.TRANSPOSED_POSES)

    @pytest.mark.parametrize("corners", [False, True])
    def test_data_of_the_other_mount(self, mount: str, corners: bool) -> None:
        views = make_views(0, 20, mount=mount, **QUIET)[0] if corners else poses_of(0, 20, mount)
        assert_refused(replace(views, mount="flange" if mount == "fixed" else "fixed"), Reason.WRONG_MOUNT)

    @pytest.mark.parametrize("shift", [1, -1])
    def test_images_paired_with_the_wrong_pose(self, mount: str, shift: int) -> None:
        poses = poses_of(0, 20, mount)
        shifted = replace(poses, T_camera_board=np.roll(poses.T_camera_board, shift, axis=0))
        assert_refused(shifted, Reason.SHIFTED_PAIRING, "before" if shift == 1 else "after")

    def test_a_lost_image_shifts_the_rest(self, mount: str) -> None:
        views, _ = make_views(0, 20, mount=mount, **QUIET)
        lost = replace(views, corners=(*views.corners[:14], *views.corners[15:], views.corners[19]))
        assert_refused(lost, Reason.SHIFTED_PAIRING, "from view_014 on")

    @pytest.mark.parametrize("factor", [1.05, 0.95])
    def test_wrong_square_size(self, mount: str, factor: float) -> None:
        views, _ = make_views(0, 20, mount=mount, **QUIET)
        board = BOARD.model_copy(update={"square_m": factor * BOARD.square_m})
        assert_refused(replace(views, board=board), Reason.WRONG_SQUARE_SIZE, f"{100 / factor:.0f}")
        poses = poses_of(0, 20, mount)
        seen = poses.T_camera_board.copy()
        seen[:, :3, 3] *= factor
        assert_refused(replace(poses, T_camera_board=seen), Reason.WRONG_SQUARE_SIZE)

    @pytest.mark.parametrize("sides", [("T_camera_board",), ("T_base_flange",), ("T_camera_board", "T_base_flange")])
    def test_millimetres(self, mount: str, sides: tuple[str, ...]) -> None:
        poses = poses_of(0, 20, mount)
        for side in sides:
            T = getattr(poses, side).copy()
            T[:, :3, 3] *= 1000
            poses = replace(poses, **{side: T})
        assert_refused(poses, Reason.WRONG_UNITS)

    def test_views_that_have_nothing_to_do_with_each_other(self, mount: str) -> None:
        assert_refused(with_outliers(poses_of(0, 20, mount), range(20)), Reason.INCONSISTENT)

    def test_half_of_the_views_wrong(self, mount: str) -> None:
        assert_refused(with_outliers(poses_of(0, 30, mount), range(0, 30, 2)), Reason.INCONSISTENT)

    def test_noise_too_large_to_be_used(self, mount: str) -> None:
        views, truth = make_views(0, 14, mount=mount, tilt_rad=0.12)
        assert_refused(as_poses(views, truth, position_m=0.004, rotation_rad=0.004), Reason.UNCERTAIN)


def test_one_mirrored_view_is_left_out_and_named() -> None:
    poses = poses_of(0, 20)
    seen = poses.T_camera_board.copy()
    seen[7] = np.diag([-1.0, 1.0, 1.0, 1.0]) @ seen[7]
    solution = solve(replace(poses, T_camera_board=seen))
    assert solution.accepted
    assert solution.rejected == ("view_007",)
