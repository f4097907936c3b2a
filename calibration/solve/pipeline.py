"""From views to a verdict: `solve` is the whole of the calibration's mathematics in one call."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.board_pose import MIN_CORNERS, start_poses, usable_corners
from calibration.solve.consensus import find_consensus
from calibration.solve.depth_correction import fit_depth
from calibration.solve.handeye import Fit, predict
from calibration.solve.mistakes import find_mistake, find_partial_shift
from calibration.solve.model_selection import (
    Candidate,
    best_of,
    fit_candidates,
    fit_with_free_scale,
    moved_arm,
)
from calibration.solve.observations import observe_board
from calibration.solve.projection import intrinsics_vector, stack_corners
from calibration.solve.solution import Estimate, Solution, ViewErrors
from calibration.solve.time_alignment import align
from calibration.solve.verdict import (
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
from calibration.solve.views import Views
from robotcell.errors import CalibrationError
from robotcell.geometry.transforms import make_transform

if TYPE_CHECKING:
    import numpy.typing as npt

    from calibration.solve.depth_correction import DepthFit
    from calibration.solve.time_series import Series
    from robotcell.config.calibration_file import CameraModel, Mount
    from robotcell.geometry.transforms import Array


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


def _solve_usable(views: Views, refine_intrinsics: bool) -> tuple[Verdict, Estimate | None, tuple[ViewErrors, ...]]:
    M, on_the_arm = views.T_parent_child, views.mount == "fixed"
    observed = observe_board(views)
    as_given = find_consensus(M, observed.T_camera_board, free_scale=True)
    mistake = find_mistake(M, observed.T_camera_board, on_the_arm, as_given)
    if mistake:
        return mistake, None, tuple(ViewErrors(name, used=True) for name in views.names)
    candidates = fit_candidates(views, M, observed, on_the_arm, refine_intrinsics)
    best = best_of(candidates if refine_intrinsics else [each for each in candidates if not each.refined])
    free = fit_with_free_scale(M, best.observed, best.fit, on_the_arm)
    scale_sigma = float(np.sqrt(free.covariance[12, 12]))
    C, lever = best.observed.T_camera_board, best.observed.lever_m
    verdict = (
        find_partial_shift(M, C, best.X, best.Z, best.fit.used, views.names, lever)
        or (check_scale(free.scale, scale_sigma) if _turns_agree(free) else None)
        or _check_used(best, M, len(views))
        or check_intrinsics(best.score, min(candidate.score for candidate in candidates))
        or _check_result(best)
    )
    return verdict, _estimate(views, best, float(free.scale), scale_sigma), _view_errors(views, best)


def _turns_agree(fit: Fit) -> bool:
    turns = np.linalg.norm(fit.disagreement[fit.used, 3:], axis=1)
    return bool(fit.used.mean() >= MIN_USED_SHARE and np.rad2deg(np.median(turns)) < MAX_HELD_OUT_DEG)


def _check_used(best: Candidate, M: Array, views: int) -> Verdict | None:
    used = best.fit.used
    if used.mean() < MIN_USED_SHARE:
        return refuse(Reason.INCONSISTENT, f"only {used.sum()} of {views} usable views agree with each other")
    if used.sum() < MIN_VIEWS:
        return _too_few(int(used.sum()), views)
    return check_rotation(rotation_spread_deg(M[used]))


def _check_result(best: Candidate) -> Verdict:
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


def _estimate(views: Views, best: Candidate, scale: float, scale_sigma: float) -> Estimate:
    sigmas = np.sqrt(best.fit.variances).tolist()
    if (
        best.observed.stack is None
        or best.observed.intrinsics is None
        or best.observed.poses is None
        or views.camera is None
    ):
        Z, camera = best.Z, None
        noise = dict(zip(("across_view_m", "along_view_m", "tilt_rad", "roll_rad"), sigmas, strict=True))
    else:
        Z = best.Z @ make_transform(np.eye(3), -best.observed.stack.center)
        camera = _with_intrinsics(views.camera, best.observed.intrinsics) if best.refined else views.camera
        noise = dict(zip(("flange_position_m", "flange_rotation_rad", "corner_shared_px"), sigmas, strict=True))
        noise["corner_px"] = best.observed.poses.sigma_px
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


def _depth(views: Views, best: Candidate) -> DepthFit | None:
    """From the board's plane as camera and arm together have it."""
    stack = best.observed.stack
    if views.corners is None or stack is None:
        return None
    T = predict(best.X, best.Z, moved_arm(views.T_parent_child, best.arm, views.mount == "fixed"))
    z = (stack.points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])[..., 2]
    measured, true = [], []
    for i, corners in enumerate(views.corners):
        if best.fit.used[i] and corners.depth_m is not None:
            measured.append(corners.depth_m)
            true.append(z[i, : len(corners.ids)])
    return fit_depth(np.concatenate(measured), np.concatenate(true)) if measured else None


def _view_errors(views: Views, best: Candidate) -> tuple[ViewErrors, ...]:
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
