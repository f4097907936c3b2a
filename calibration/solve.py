"""From views to a verdict: `solve` is the whole of the calibration's mathematics in one call."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np

from calibration.board_pose import (
    MIN_CORNERS,
    BoardPoses,
    refine_poses,
    settle_ambiguity,
    start_poses,
    usable_corners,
    without_false_corners,
)
from calibration.bundle import BundleNoise, solve_bundle
from calibration.closed_form import CLOSED_FORMS
from calibration.consensus import find_consensus
from calibration.depth import fit_depth
from calibration.handeye import FLOOR, Fit, Noise, arm_noise, pose_noise, predict, refine, reject_outliers
from calibration.mistakes import find_mistake, find_partial_shift
from calibration.projection import CornerStack, intrinsics_vector, project, stack_corners
from calibration.rigid import change, difference
from calibration.series import Series, align
from calibration.solution import Estimate, Solution, ViewErrors
from calibration.verdict import (
    MAX_HELD_OUT_DEG,
    MIN_USED_SHARE,
    MIN_VIEWS,
    Reason,
    Verdict,
    check_intrinsics,
    check_result,
    check_rotation,
    check_scale,
    refuse,
    rotation_spread_deg,
)
from calibration.views import Views
from robotcell.errors import CalibrationError
from robotcell.geometry import make_transform

if TYPE_CHECKING:
    import numpy.typing as npt

    from calibration.depth import DepthFit
    from robotcell.camera_calibration import CameraModel, Mount
    from robotcell.geometry import Array

# Outliers are found again with the noise's shapes at the first result.
_PASSES = 2
# Held-out errors that differ by less are equal.
_CLEARLY = 0.01
# A turn counts as the distance that it moves a point this share of the way between camera and board.
_LEVER = 0.4


def solve(views: Views, *, refine_intrinsics: bool = False) -> Solution:
    """Find where the camera stands, how sure that is, and whether it may be used.

    Args:
        views: poses or corners.
        refine_intrinsics: estimate the intrinsics as well; they are kept as given where that predicts held-out views
            better. Needs corners.

    Raises:
        ValueError: intrinsics are to be refined from poses.
    """
    if refine_intrinsics and views.corners is None:
        raise ValueError("intrinsics can only be refined from corners, not from poses")
    why = _unusable(views)
    usable = np.array([not reason for reason in why])
    mirrored = _mirrored(views)
    if mirrored.sum() > len(views) / 2:
        verdict = refuse(Reason.MIRRORED, f"{mirrored.sum()} of {len(views)} views have matrices of determinant -1")
        return _refused(views, why, verdict)
    if usable.sum() < MIN_VIEWS:
        return _refused(views, why, _too_few(int(usable.sum()), len(views)))
    index = np.flatnonzero(usable)
    chosen = views.subset(index)
    spread = rotation_spread_deg(chosen.T_parent_child)
    too_little = check_rotation(spread)
    if too_little:
        return replace(_refused(views, why, too_little), rotation_spread_deg=tuple(spread.tolist()))
    verdict, estimate, errors = _solve_usable(chosen, refine_intrinsics)
    all_errors = [ViewErrors(name, used=False, why=reason) for name, reason in zip(views.names, why, strict=True)]
    for i, error in zip(index, errors, strict=True):
        all_errors[i] = error
    return Solution(views, verdict, tuple(all_errors), estimate, tuple(spread.tolist()))


def solve_series(flange: Series, board: Series, mount: Mount) -> Solution:
    """Solve two time series with clocks of their own; what cannot be aligned is refused.

    Args:
        flange: T_base_flange.
        board: T_camera_board.
        mount: where the camera is.
    """
    now = datetime.now(timezone.utc)
    try:
        views = align(flange, board, mount, now)
    except CalibrationError as error:
        none = Views(mount, (), np.empty((0, 4, 4)), now, np.empty((0, 4, 4)))
        return Solution(none, refuse(Reason.CLOCKS, str(error)), ())
    return solve(views)


@dataclass(frozen=True)
class _Sight:
    """What the camera saw: poses of the board, and the corners behind them where there are any.

    With corners the board's origin is the mean of its corners.
    """

    T_camera_board: Array
    poses: BoardPoses | None = None
    stack: CornerStack | None = None
    intrinsics: Array | None = None


@dataclass(frozen=True)
class _Candidate:
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
    sight: _Sight
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
        return float(np.median(distance + _lever(self.sight) * turn))


def _solve_usable(views: Views, refine_intrinsics: bool) -> tuple[Verdict, Estimate | None, tuple[ViewErrors, ...]]:
    M, on_the_arm = views.T_parent_child, views.mount == "fixed"
    sight = _look(views)
    as_given = find_consensus(M, sight.T_camera_board, free_scale=True)
    mistake = find_mistake(M, sight.T_camera_board, on_the_arm, as_given)
    if mistake:
        return mistake, None, tuple(ViewErrors(name, used=True) for name in views.names)
    candidates = _candidates(views, M, sight, on_the_arm, refine_intrinsics)
    best = _best(candidates if refine_intrinsics else [each for each in candidates if not each.refined])
    free = _free_scale(M, best.sight, best.fit, on_the_arm)
    scale_sigma = float(np.sqrt(free.covariance[12, 12]))
    C, lever = best.sight.T_camera_board, _lever(best.sight)
    verdict = (
        find_partial_shift(M, C, best.X, best.Z, best.fit.used, views.names, lever)
        or (check_scale(free.scale, scale_sigma) if _turns_agree(free) else None)
        or _check_used(best, M, len(views))
        or check_intrinsics(best.score, min(candidate.score for candidate in candidates))
        or _check_result(best)
    )
    return verdict, _estimate(views, best, float(free.scale), scale_sigma), _view_errors(views, best)


def _look(views: Views) -> _Sight:
    """The board's poses as the camera saw them."""
    if views.corners is None or views.board is None or views.camera is None:
        assert views.T_camera_board is not None
        return _Sight(views.T_camera_board)
    stack = stack_corners(views.corners, views.board.corners())
    intrinsics = intrinsics_vector(views.camera)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    expected = find_consensus(views.T_parent_child, poses.T_camera_board, free_scale=True)
    T_expected = predict(expected.X, expected.Z, views.T_parent_child)
    T_expected[:, :3, 3] /= expected.scale
    poses = settle_ambiguity(stack, intrinsics, poses, T_expected)
    stack = without_false_corners(stack, intrinsics, poses)
    return _sight(stack, intrinsics, refine_poses(stack, intrinsics, poses.T_camera_board))


def _sight(stack: CornerStack, intrinsics: Array, poses: BoardPoses) -> _Sight:
    return _Sight(poses.T_camera_board, poses, stack, intrinsics)


def _candidates(views: Views, M: Array, sight: _Sight, on_the_arm: bool, refine_intrinsics: bool) -> list[_Candidate]:
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


def _best(candidates: list[_Candidate]) -> _Candidate:
    """The least held-out error; a later one must be clearly better."""
    best = candidates[0]
    for candidate in candidates[1:]:
        if candidate.score < (1 - _CLEARLY) * best.score:
            best = candidate
    return best


def _from_poses(M: Array, sight: _Sight, on_the_arm: bool) -> _Candidate:
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
    return _best(candidates)


def _pose_candidate(start: str, M: Array, sight: _Sight, fit: Fit) -> _Candidate:
    carried = predict(fit.X_held_out, fit.Z_held_out, M)
    px = None
    if sight.stack is not None and sight.intrinsics is not None:
        px = _held_out_px(sight.stack, carried, sight.intrinsics)
    return _Candidate(
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
    M: Array, start: _Candidate, camera: CameraModel, on_the_arm: bool, *, refine_intrinsics: bool = False
) -> _Candidate:
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
    return _Candidate(
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


def _noise(M: Array, sight: _Sight, X: Array, on_the_arm: bool) -> Noise:
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


def _lever(sight: _Sight) -> float:
    return _LEVER * float(np.median(np.linalg.norm(sight.T_camera_board[:, :3, 3], axis=1)))


def _free_scale(M: Array, sight: _Sight, fit: Fit, on_the_arm: bool) -> Fit:
    """The same with the scale of the camera's distances free."""
    C = sight.T_camera_board
    consensus = find_consensus(M, C, free_scale=True)
    noise = _noise(M, sight, fit.X, on_the_arm)
    return reject_outliers(consensus.X, consensus.Z, M, C, noise, scale=consensus.scale, free_scale=True)


def _turns_agree(fit: Fit) -> bool:
    turns = np.linalg.norm(fit.disagreement[fit.used, 3:], axis=1)
    return bool(fit.used.mean() >= MIN_USED_SHARE and np.rad2deg(np.median(turns)) < MAX_HELD_OUT_DEG)


def _check_used(best: _Candidate, M: Array, views: int) -> Verdict | None:
    used = best.fit.used
    if used.mean() < MIN_USED_SHARE:
        return refuse(Reason.INCONSISTENT, f"only {used.sum()} of {views} usable views agree with each other")
    if used.sum() < MIN_VIEWS:
        return _too_few(int(used.sum()), views)
    return check_rotation(rotation_spread_deg(M[used]))


def _check_result(best: _Candidate) -> Verdict:
    distance, turn = best.off()
    used = best.fit.used
    sigma_m, sigma_rad = (
        float(np.sqrt(np.linalg.eigvalsh(best.covariance[part, part])[-1])) for part in (slice(0, 3), slice(3, 6))
    )
    return check_result(
        float(1e3 * np.median(distance[used])),
        float(np.rad2deg(np.median(turn[used]))),
        1e3 * sigma_m,
        float(np.rad2deg(sigma_rad)),
    )


def _estimate(views: Views, best: _Candidate, scale: float, scale_sigma: float) -> Estimate:
    sigmas = np.sqrt(best.fit.variances).tolist()
    if best.sight.stack is None or best.sight.intrinsics is None or best.sight.poses is None or views.camera is None:
        Z, camera = best.Z, None
        noise = dict(zip(("across_view_m", "along_view_m", "tilt_rad", "roll_rad"), sigmas, strict=True))
    else:
        Z = best.Z @ make_transform(np.eye(3), -best.sight.stack.center)
        camera = _with_intrinsics(views.camera, best.sight.intrinsics) if best.refined else views.camera
        noise = dict(zip(("flange_position_m", "flange_rotation_rad", "corner_shared_px"), sigmas, strict=True))
        noise["corner_px"] = best.sight.poses.sigma_px
    return Estimate(
        X=best.X,
        Z=Z,
        covariance=(best.covariance + best.covariance.T) / 2,
        camera=camera,
        intrinsics_refined=best.refined,
        method=best.method,
        noise=noise,
        scale=scale,
        scale_sigma=scale_sigma,
        depth=_depth(views, best),
    )


def _with_intrinsics(camera: CameraModel, intrinsics: Array) -> CameraModel:
    fx, fy, cx, cy, *dist = intrinsics.tolist()
    return camera.model_copy(update={"fx": fx, "fy": fy, "cx": cx, "cy": cy, "dist": tuple(dist)})


def _depth(views: Views, best: _Candidate) -> DepthFit | None:
    """From the board's plane as camera and arm together have it."""
    stack = best.sight.stack
    if views.corners is None or stack is None:
        return None
    T = predict(best.X, best.Z, _moved(views.T_parent_child, best.arm, views.mount == "fixed"))
    z = (stack.points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])[..., 2]
    measured, true = [], []
    for i, corners in enumerate(views.corners):
        if best.fit.used[i] and corners.depth_m is not None:
            measured.append(corners.depth_m)
            true.append(z[i, : len(corners.ids)])
    return fit_depth(np.concatenate(measured), np.concatenate(true)) if measured else None


def _moved(M: Array, arm: Array, on_the_arm: bool) -> Array:
    """The arm's poses after small changes (V, 6) of the flange, in its own axes."""
    changes = change(np.tile(np.eye(4), (len(M), 1, 1)), arm)
    return np.asarray(M @ changes if on_the_arm else changes @ M)


def _view_errors(views: Views, best: _Candidate) -> tuple[ViewErrors, ...]:
    distance, turn = best.off()
    errors = []
    for i, name in enumerate(views.names):
        mm, deg, used = float(1e3 * distance[i]), float(np.rad2deg(turn[i])), bool(best.fit.used[i])
        why = "" if used else f"does not agree with the others: {mm:.1f} mm and {deg:.2f} degrees off"
        errors.append(ViewErrors(name, used, why, mm, deg, None if best.px is None else float(best.px[i])))
    return tuple(errors)


def _mirrored(views: Views) -> npt.NDArray[np.bool_]:
    """(V,) views with a matrix of determinant -1."""
    mirrored = np.linalg.det(views.T_base_flange[:, :3, :3]) < 0
    if views.T_camera_board is not None:
        mirrored = mirrored | (np.linalg.det(views.T_camera_board[:, :3, :3]) < 0)
    return np.asarray(mirrored)


def _unusable(views: Views) -> list[str]:
    """Why a view cannot be used by itself; empty where it can."""
    why = ["mirrored: a matrix has determinant -1" if mirrored else "" for mirrored in _mirrored(views)]
    if views.corners is None or views.board is None or views.camera is None:
        return why
    stack = stack_corners(views.corners, views.board.corners())
    usable = usable_corners(stack)
    for i in np.flatnonzero(~usable):
        count = len(views.corners[i].ids)
        why[i] = (
            f"{count} corners; {MIN_CORNERS} are needed"
            if count < MIN_CORNERS
            else "its corners lie on one line or in one spot"
        )
    index = np.flatnonzero(usable)
    found = np.isfinite(start_poses(stack.subset(index), intrinsics_vector(views.camera))).all(axis=(1, 2))
    for i in index[~found]:
        why[i] = "its corners fit no pose of the board"
    return why


def _too_few(usable: int, views: int) -> Verdict:
    return refuse(Reason.TOO_FEW_VIEWS, f"{usable} of {views} views are usable")


def _refused(views: Views, why: list[str], verdict: Verdict) -> Solution:
    errors = [ViewErrors(name, used=not reason, why=reason) for name, reason in zip(views.names, why, strict=True)]
    return Solution(views, verdict, tuple(errors))
