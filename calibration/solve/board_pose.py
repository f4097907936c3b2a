"""Where the board stands in front of the camera, from its corners in one image, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from calibration.solve.projection import CornerStack, project
from calibration.solve.robust_weights import corner_weights
from calibration.solve.se3 import change, skew
from robotcell.geometry.transforms import make_transform

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

# Fewer, or corners on one line, leave the tilt to chance.
MIN_CORNERS = 6
_MIN_WIDTH = 0.05
_MIN_WIDTH_PX = 2.0
_ITERATIONS = 20
_CONVERGED = 1e-10
_DAMPING = 1e-12
# The two poses under which a flat board looks alike differ in their residuals by little when it is far away.
_AMBIGUOUS = 1.5
_FLAT_M = 1e-6
# A corner so many standard deviations off was taken for another one.
_FALSE = 6.0
_LEAST_PX = 0.05


@dataclass(frozen=True)
class BoardPoses:
    """Poses of the board's centre, one per view.

    Attributes:
        T_camera_board: (V, 4, 4), the origin is the mean of the board's corners.
        information: (V, 6, 6) of the small change of that pose in axes of the camera, for corners of 1 px noise.
        sigma_px: standard deviation of a corner's coordinate within the views [px].
        rms_px: (V,) of each view [px].
    """

    T_camera_board: Array
    information: Array
    sigma_px: float
    rms_px: Array


def usable_corners(stack: CornerStack) -> npt.NDArray[np.bool_]:
    """(V,) bool: enough corners, not all on one line, neither on the board nor in the image."""
    usable = np.zeros(len(stack.px), dtype=bool)
    for i, (points, px, seen) in enumerate(zip(stack.points, stack.px, stack.seen > 0, strict=True)):
        if seen.sum() >= MIN_CORNERS:
            on_board = np.linalg.svd(points[seen] - points[seen].mean(axis=0), compute_uv=False)
            in_image = np.linalg.svd(px[seen] - px[seen].mean(axis=0), compute_uv=False)
            wide_px = in_image[1] / np.sqrt(seen.sum())
            usable[i] = on_board[1] > _MIN_WIDTH * on_board[0] and wide_px > _MIN_WIDTH_PX
    return usable


def start_poses(stack: CornerStack, intrinsics: Array) -> Array:
    """T_camera_board (V, 4, 4) of each view alone; NaN where none was found."""
    camera = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    poses = np.full((len(stack.px), 4, 4), np.nan)
    for i, (points, px, seen) in enumerate(zip(stack.points, stack.px, stack.seen > 0, strict=True)):
        flat = np.ptp(points[seen][:, 2]) < _FLAT_M
        method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
        try:
            found, rotvecs, positions, _ = cv2.solvePnPGeneric(
                points[seen], px[seen], camera, intrinsics[4:], flags=method
            )
        except cv2.error:
            continue
        if found and np.isfinite(rotvecs[0]).all() and positions[0][2, 0] > 0:
            poses[i] = make_transform(cv2.Rodrigues(rotvecs[0])[0], positions[0].ravel())
    return poses


def refine_poses(stack: CornerStack, intrinsics: Array, start: Array) -> BoardPoses:
    """Least reprojection error of each view alone, false corners held back.

    Args:
        stack: corners.
        intrinsics: (9,).
        start: T_camera_board (V, 4, 4).
    """
    T = start
    sigma = np.inf
    for _ in range(_ITERATIONS):
        residual, J = _linearise(stack, intrinsics, T)
        sigma = _sigma(residual, stack, sigma)
        weight = corner_weights(residual, stack.seen, sigma)
        information = np.einsum("vk,vkip,vkiq->vpq", weight, J, J, optimize=True)
        gradient = np.einsum("vk,vkip,vki->vp", weight, J, residual, optimize=True)
        # False corners can leave a pose without any hold; the others are not moved by so little.
        information += _DAMPING * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        step = np.linalg.solve(information, gradient[..., None])[..., 0]
        T = change(T, step)
        if np.abs(step).max() < _CONVERGED:
            break
    rms = np.sqrt((residual**2).sum((1, 2)) / (2 * stack.counts))
    return BoardPoses(T, information, sigma, rms)


def settle_ambiguity(stack: CornerStack, intrinsics: Array, poses: BoardPoses, T_expected: Array) -> BoardPoses:
    """Take the pose next to the expected one where a flat board fits the image almost as well there.

    Args:
        stack: corners.
        intrinsics: (9,).
        poses: as found from each view alone.
        T_expected: T_camera_board (V, 4, 4) as most views have it.
    """
    in_front = T_expected[:, 2, 3] > 0
    other = refine_poses(stack, intrinsics, np.where(in_front[:, None, None], T_expected, poses.T_camera_board))
    better = other.rms_px < _AMBIGUOUS * poses.rms_px
    return refine_poses(stack, intrinsics, np.where(better[:, None, None], other.T_camera_board, poses.T_camera_board))


def without_false_corners(stack: CornerStack, intrinsics: Array, poses: BoardPoses) -> CornerStack:
    """Leave out corners that are elsewhere than their view's others say; views that would keep too few stay whole."""
    residual, _ = _linearise(stack, intrinsics, poses.T_camera_board)
    true = np.linalg.norm(residual, axis=-1) < _FALSE * max(poses.sigma_px, _LEAST_PX)
    seen = stack.seen * true
    too_few = seen.sum(axis=1) < MIN_CORNERS
    return CornerStack(stack.points, stack.px, np.where(too_few[:, None], stack.seen, seen), stack.center)


def _linearise(stack: CornerStack, intrinsics: Array, T: Array) -> tuple[Array, Array]:
    """Residuals (V, K, 2), and the derivatives (V, K, 2, 6) of the prediction by the small change of the pose."""
    turned = stack.points @ np.swapaxes(T[:, :3, :3], 1, 2)
    px, by_point, _ = project(turned + T[:, None, :3, 3], intrinsics)
    return stack.px - px, np.concatenate([by_point, -by_point @ skew(turned)], axis=-1)


def _sigma(residual: Array, stack: CornerStack, before: float) -> float:
    """Standard deviation of a corner's coordinate [px]; the six numbers of each pose are paid for."""
    freedom = max(2 * stack.seen.sum() - 6 * len(stack.px), 1.0)
    if not np.isfinite(before):
        # Median length of a vector of two standard normal numbers: sqrt(2 ln 2).
        size = np.linalg.norm(residual, axis=-1)[stack.seen > 0]
        sigma = float(np.median(size) / np.sqrt(2 * np.log(2)))
    else:
        # Huber's proposal 2: a residual counts up to the size from which on its weight falls.
        weight = corner_weights(residual, stack.seen, before)
        sigma = float(np.sqrt(((weight[..., None] * residual) ** 2).sum() / freedom))
    return max(sigma, 1e-6)
