"""Model selection: the fits to choose from, and the one with the least error on views that took no part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.board_pose import refine_poses
from calibration.solve.bundle_adjustment import BundleNoise, solve_bundle
from calibration.solve.closed_form import CLOSED_FORMS
from calibration.solve.consensus import find_consensus
from calibration.solve.handeye import Fit, predict, refine, reject_outliers
from calibration.solve.observations import BoardObservations, observations
from calibration.solve.projection import CornerStack, intrinsics_vector, project
from calibration.solve.se3 import change, difference
from calibration.solve.variance_components import FLOOR, Noise, arm_noise, pose_noise

if TYPE_CHECKING:
    from calibration.solve.views import Views
    from robotcell.config.calibration_file import CameraModel
    from robotcell.geometry.transforms import Array

# Outliers are found again with the noise's shapes at the first result.
_PASSES = 2
# Held-out errors that differ by less are equal.
_CLEARLY = 0.01


@dataclass(frozen=True)
class Candidate:
    """A result, and where the arm carries the board in views that take no part.

    Attributes:
        method: that gave it.
        observed: that it rests on.
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
    observed: BoardObservations
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
        e = difference(self.observed.T_camera_board, self.T_camera_board)
        return np.asarray(np.linalg.norm(e[:, :3], axis=1)), np.asarray(np.linalg.norm(e[:, 3:], axis=1))

    @property
    def score(self) -> float:
        """Held-out error of the median view [px]; without corners [m], with turns at a lever."""
        if self.px is not None:
            return float(np.median(self.px))
        distance, turn = self.off()
        return float(np.median(distance + self.observed.lever_m * turn))


def fit_candidates(
    views: Views, M: Array, observed: BoardObservations, on_the_arm: bool, refine_intrinsics: bool
) -> list[Candidate]:
    """Results to choose from, the one that is taken between equals first.

    One with refined intrinsics is always among them: it tells whether those that were given can be true.
    """
    from_poses = _from_poses(M, observed, on_the_arm)
    if views.camera is None or observed.stack is None:
        return [from_poses]
    candidates = [_bundle(M, from_poses, views.camera, on_the_arm), from_poses]
    refined = _bundle(M, from_poses, views.camera, on_the_arm, refine_intrinsics=True)
    if refine_intrinsics:
        # Noise and outliers look different through the right lens.
        refined = _bundle(
            M, _from_poses(M, refined.observed, on_the_arm), views.camera, on_the_arm, refine_intrinsics=True
        )
    return [*candidates, refined]


def best_of(candidates: list[Candidate]) -> Candidate:
    """The least held-out error; a later one must be clearly better."""
    best = candidates[0]
    for candidate in candidates[1:]:
        if candidate.score < (1 - _CLEARLY) * best.score:
            best = candidate
    return best


def fit_with_free_scale(M: Array, observed: BoardObservations, fit: Fit, on_the_arm: bool) -> Fit:
    """The same with the scale of the camera's distances free."""
    C = observed.T_camera_board
    consensus = find_consensus(M, C, free_scale=True)
    noise = _noise(M, observed, fit.X, on_the_arm)
    return reject_outliers(consensus.X, consensus.Z, M, C, noise, scale=consensus.scale, free_scale=True)


def moved_arm(M: Array, arm: Array, on_the_arm: bool) -> Array:
    """The arm's poses after small changes (V, 6) of the flange, in its own axes."""
    changes = change(np.tile(np.eye(4), (len(M), 1, 1)), arm)
    return np.asarray(M @ changes if on_the_arm else changes @ M)


def _from_poses(M: Array, observed: BoardObservations, on_the_arm: bool) -> Candidate:
    """Refinement in SE(3) from every closed form, outliers left out."""
    C = observed.T_camera_board
    consensus = find_consensus(M, C)
    X, Z = consensus.X, consensus.Z
    for _ in range(_PASSES):
        noise = _noise(M, observed, X, on_the_arm)
        fit = reject_outliers(X, Z, M, C, noise)
        X, Z = fit.X, fit.Z
    candidates = [_pose_candidate("consensus", M, observed, fit)]
    for name, closed_form in CLOSED_FORMS.items():
        try:
            X, Z = closed_form(M[fit.used], C[fit.used])
        except ValueError:
            continue
        candidates.append(
            _pose_candidate(name, M, observed, refine(X, Z, M, C, noise, fit.used, variances=fit.variances))
        )
    return best_of(candidates)


def _pose_candidate(start: str, M: Array, observed: BoardObservations, fit: Fit) -> Candidate:
    carried = predict(fit.X_held_out, fit.Z_held_out, M)
    px = None
    if observed.stack is not None and observed.intrinsics is not None:
        px = _held_out_px(observed.stack, carried, observed.intrinsics)
    return Candidate(
        f"{start}, refined in SE(3)",
        observed,
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
    stack, fit = start.observed.stack, start.fit
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
    observed = start.observed
    if refine_intrinsics:
        poses = refine_poses(stack, bundle.intrinsics, observed.T_camera_board)
        observed = observations(stack, bundle.intrinsics, poses)
    return Candidate(
        start.method.replace("refined in SE(3)", "bundle over corners"),
        observed,
        fit,
        bundle.X,
        bundle.Z,
        bundle.covariance + fit.uncertain_weights[:6, :6],
        arm,
        carried,
        _held_out_px(stack, carried, intrinsics[:, None]),
        refine_intrinsics,
    )


def _noise(M: Array, observed: BoardObservations, X: Array, on_the_arm: bool) -> Noise:
    C = observed.T_camera_board
    if observed.poses is None:
        return pose_noise(C)
    # The arm's errors, and those of the corners; what the corners of a view have in common raises the latter.
    shapes = np.concatenate(
        [arm_noise(X, M, C, on_the_arm=on_the_arm), np.linalg.inv(observed.poses.information)[None]]
    )
    return Noise(shapes, np.array([FLOOR**2, FLOOR**2, observed.poses.sigma_px**2]))


def _held_out_px(stack: CornerStack, T_camera_board: Array, intrinsics: Array) -> Array:
    """(V,) root mean square distance of corners [px]."""
    points = stack.points @ np.swapaxes(T_camera_board[:, :3, :3], 1, 2) + T_camera_board[:, None, :3, 3]
    px, _, _ = project(points, intrinsics, derivatives=False)
    squared = ((stack.px - px) ** 2).sum(axis=2) * stack.seen
    return np.asarray(np.sqrt(squared.sum(axis=1) / stack.counts))
