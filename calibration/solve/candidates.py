"""Results to choose from: what the camera saw, the fits to it, and their errors on views that took no part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.board_pose import BoardPoses, refine_poses, settle_ambiguity, start_poses, without_false_corners
from calibration.solve.bundle import BundleNoise, solve_bundle
from calibration.solve.closed_form import CLOSED_FORMS
from calibration.solve.consensus import LEVER, find_consensus
from calibration.solve.handeye import FLOOR, Fit, Noise, arm_noise, pose_noise, predict, refine, reject_outliers
from calibration.solve.projection import CornerStack, intrinsics_vector, project, stack_corners
from calibration.solve.rigid import change, difference

if TYPE_CHECKING:
    from calibration.solve.views import Views
    from robotcell.config.calibration_file import CameraModel
    from robotcell.geometry.transforms import Array

# Outliers are found again with the noise's shapes at the first result.
_PASSES = 2
# Held-out errors that differ by less are equal.
_CLEARLY = 0.01


@dataclass(frozen=True)
class Sight:
    """What the camera saw: poses of the board, and the corners behind them where there are any.

    With corners the board's origin is the mean of its corners.
    """

    T_camera_board: Array
    poses: BoardPoses | None = None
    stack: CornerStack | None = None
    intrinsics: Array | None = None


@dataclass(frozen=True)
class Candidate:
    """A result, and where the arm carries the board in views that take no part.

    Attributes:
        method: that gave it.
        sight: that it rests on.
        fit: on poses, behind it.
        X: T_parent_camera.
        Z: T_child_board.
        covariance: (6, 6) of X.
        arm: (V, 6) small changes of the arm's poses.
        T_camera_board: (V, 4, 4) as the arm has it, held-out.
        px: (V,) held-out error of the corners; None without.
        refined: the intrinsics were.
    """

    method: str
    sight: Sight
    fit: Fit
    X: Array
    Z: Array
    covariance: Array
    arm: Array
    T_camera_board: Array
    px: Array | None = None
    refined: bool = False

    def off(self) -> tuple[Array, Array]:
        """Held-out distance [m] and turn [rad] of each view (V,)."""
        e = difference(self.sight.T_camera_board, self.T_camera_board)
        return np.asarray(np.linalg.norm(e[:, :3], axis=1)), np.asarray(np.linalg.norm(e[:, 3:], axis=1))

    @property
    def score(self) -> float:
        """Held-out error of the median view [px]; without corners [m], with turns at a lever."""
        if self.px is not None:
            return float(np.median(self.px))
        distance, turn = self.off()
        return float(np.median(distance + lever_m(self.sight) * turn))


def look(views: Views) -> Sight:
    """The board's poses as the camera saw them."""
    if views.corners is None or views.board is None or views.camera is None:
        assert views.T_camera_board is not None
        return Sight(views.T_camera_board)
    stack = stack_corners(views.corners, views.board.corners())
    intrinsics = intrinsics_vector(views.camera)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    expected = find_consensus(views.T_parent_child, poses.T_camera_board, free_scale=True)
    T_expected = predict(expected.X, expected.Z, views.T_parent_child)
    T_expected[:, :3, 3] /= expected.scale
    poses = settle_ambiguity(stack, intrinsics, poses, T_expected)
    stack = without_false_corners(stack, intrinsics, poses)
    return _sight(stack, intrinsics, refine_poses(stack, intrinsics, poses.T_camera_board))


def find_candidates(views: Views, M: Array, sight: Sight, on_the_arm: bool, refine_intrinsics: bool) -> list[Candidate]:
    """Results to choose from, the one that is taken between equals first.

    One with refined intrinsics is always among them: it tells whether those that were given can be true.
    """
    from_poses = _from_poses(M, sight, on_the_arm)
    if views.camera is None or sight.stack is None:
        return [from_poses]
    candidates = [_bundle(M, from_poses, views.camera, on_the_arm), from_poses]
    refined = _bundle(M, from_poses, views.camera, on_the_arm, refine_intrinsics=True)
    if refine_intrinsics:
        # Noise and outliers look different through the right lens.
        refined = _bundle(
            M, _from_poses(M, refined.sight, on_the_arm), views.camera, on_the_arm, refine_intrinsics=True
        )
    return [*candidates, refined]


def best_of(candidates: list[Candidate]) -> Candidate:
    """The least held-out error; a later one must be clearly better."""
    best = candidates[0]
    for candidate in candidates[1:]:
        if candidate.score < (1 - _CLEARLY) * best.score:
            best = candidate
    return best


def fit_with_free_scale(M: Array, sight: Sight, fit: Fit, on_the_arm: bool) -> Fit:
    """The same with the scale of the camera's distances free."""
    C = sight.T_camera_board
    consensus = find_consensus(M, C, free_scale=True)
    noise = _noise(M, sight, fit.X, on_the_arm)
    return reject_outliers(consensus.X, consensus.Z, M, C, noise, scale=consensus.scale, free_scale=True)


def lever_m(sight: Sight) -> float:
    """The distance [m] at which a turn counts."""
    return LEVER * float(np.median(np.linalg.norm(sight.T_camera_board[:, :3, 3], axis=1)))


def moved_arm(M: Array, arm: Array, on_the_arm: bool) -> Array:
    """The arm's poses after small changes (V, 6) of the flange, in its own axes."""
    changes = change(np.tile(np.eye(4), (len(M), 1, 1)), arm)
    return np.asarray(M @ changes if on_the_arm else changes @ M)


def _from_poses(M: Array, sight: Sight, on_the_arm: bool) -> Candidate:
    """Refinement in SE(3) from every closed form, outliers left out."""
    C = sight.T_camera_board
    consensus = find_consensus(M, C)
    X, Z = consensus.X, consensus.Z
    for _ in range(_PASSES):
        noise = _noise(M, sight, X, on_the_arm)
        fit = reject_outliers(X, Z, M, C, noise)
        X, Z = fit.X, fit.Z
    candidates = [_pose_candidate("consensus", M, sight, fit)]
    for name, closed_form in CLOSED_FORMS.items():
        try:
            X, Z = closed_form(M[fit.used], C[fit.used])
        except ValueError:
            continue
        candidates.append(_pose_candidate(name, M, sight, refine(X, Z, M, C, noise, fit.used, variances=fit.variances)))
    return best_of(candidates)


def _pose_candidate(start: str, M: Array, sight: Sight, fit: Fit) -> Candidate:
    carried = predict(fit.X_held_out, fit.Z_held_out, M)
    px = None
    if sight.stack is not None and sight.intrinsics is not None:
        px = _held_out_px(sight.stack, carried, sight.intrinsics)
    return Candidate(
        f"{start}, refined in SE(3)",
        sight,
        fit,
        fit.X,
        fit.Z,
        fit.covariance[:6, :6],
        np.zeros((len(M), 6)),
        carried,
        px,
    )


def _bundle(
    M: Array, start: Candidate, camera: CameraModel, on_the_arm: bool, *, refine_intrinsics: bool = False
) -> Candidate:
    """Bundle over the corners of the used views."""
    stack, fit = start.sight.stack, start.fit
    assert stack is not None
    used = np.flatnonzero(fit.used)
    position_m, rotation_rad, corner_px = np.sqrt(fit.variances)
    bundle = solve_bundle(
        stack.subset(used),
        M[used],
        BundleNoise(corner_px, position_m, rotation_rad),
        start.X,
        start.Z,
        intrinsics_vector(camera),
        on_the_arm=on_the_arm,
        width=camera.width if refine_intrinsics else None,
    )
    X, Z = np.tile(bundle.X, (len(M), 1, 1)), np.tile(bundle.Z, (len(M), 1, 1))
    intrinsics, arm = np.tile(bundle.intrinsics, (len(M), 1)), np.zeros((len(M), 6))
    X[used], Z[used], intrinsics[used], arm[used] = (
        bundle.X_held_out,
        bundle.Z_held_out,
        bundle.intrinsics_held_out,
        bundle.arm,
    )
    carried = predict(X, Z, M)
    sight = start.sight
    if refine_intrinsics:
        poses = refine_poses(stack, bundle.intrinsics, sight.T_camera_board)
        sight = _sight(stack, bundle.intrinsics, poses)
    return Candidate(
        start.method.replace("refined in SE(3)", "bundle over corners"),
        sight,
        fit,
        bundle.X,
        bundle.Z,
        bundle.covariance + fit.uncertain_weights[:6, :6],
        arm,
        carried,
        _held_out_px(stack, carried, intrinsics[:, None]),
        refine_intrinsics,
    )


def _sight(stack: CornerStack, intrinsics: Array, poses: BoardPoses) -> Sight:
    return Sight(poses.T_camera_board, poses, stack, intrinsics)


def _noise(M: Array, sight: Sight, X: Array, on_the_arm: bool) -> Noise:
    C = sight.T_camera_board
    if sight.poses is None:
        return pose_noise(C)
    # The arm's errors, and those of the corners; what the corners of a view have in common raises the latter.
    shapes = np.concatenate([arm_noise(X, M, C, on_the_arm=on_the_arm), np.linalg.inv(sight.poses.information)[None]])
    return Noise(shapes, np.array([FLOOR**2, FLOOR**2, sight.poses.sigma_px**2]))


def _held_out_px(stack: CornerStack, T_camera_board: Array, intrinsics: Array) -> Array:
    """(V,) root mean square distance of corners [px]."""
    points = stack.points @ np.swapaxes(T_camera_board[:, :3, :3], 1, 2) + T_camera_board[:, None, :3, 3]
    px, _, _ = project(points, intrinsics, derivatives=False)
    squared = ((stack.px - px) ** 2).sum(axis=2) * stack.seen
    return np.asarray(np.sqrt(squared.sum(axis=1) / stack.counts))
