"""Hand-eye calibration from poses: robust refinement in SE(3), with the noise estimated from the data.

The model is C_i = inv(X) M_i Z (see calibration.solve.views). A view's disagreement is six numbers in axes of the
camera: position of the board [m] and its turn [rad], seen minus predicted. X and Z are refined together with the
variances of its noise (calibration.solve.variance_components); the covariance of the result follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from calibration.solve.covariance import kenward_roger
from calibration.solve.robust_weights import OUTLIER, huber_weights
from calibration.solve.se3 import change, difference, invert, skew
from calibration.solve.variance_components import FLOOR, Noise, first_variances, next_variances

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

_MAX_ITERATIONS = 100
_CONVERGED = 1e-7
_CONVERGED_WEIGHTS = 1e-3
_RESTART = 0.01
_MAX_REJECTIONS = 20
# Median and mean square of the length of three standard normal numbers (chi with three degrees of freedom).
_CHI3_MEDIAN = float(np.sqrt(chi2.ppf(0.5, 3)))
# The first gate is wide; the statistical one follows.
_GATE = 6.0


@dataclass(frozen=True)
class Fit:
    """X and Z that fit the views best, and everything that follows from them.

    Attributes:
        X: T_parent_camera (4, 4).
        Z: T_child_board (4, 4).
        scale: factor on the camera's translations; 1 unless it was left free.
        variances: (K,) of the noise's components.
        covariance: (p, p) of the small changes of X, Z and, where it is free, the scale.
        uncertain_weights: (p, p) the part of it that comes from the variances being estimates themselves.
        disagreement: (V, 6) seen minus predicted, of all views.
        used: (V,) whether the view took part.
        X_held_out: (V, 4, 4) X as solved without the view; X itself where the view took no part.
        Z_held_out: (V, 4, 4) likewise.
        distance: (V,) held-out disagreement in standard deviations (Mahalanobis, six degrees of freedom).
    """

    X: Array
    Z: Array
    scale: float
    variances: Array
    covariance: Array
    uncertain_weights: Array
    disagreement: Array
    used: npt.NDArray[np.bool_]
    X_held_out: Array
    Z_held_out: Array
    distance: Array


def predict(X: Array, Z: Array, M: Array) -> Array:
    """T_camera_board (V, 4, 4) as the arm has it. X and Z are (4, 4) or (V, 4, 4)."""
    T: Array = invert(X) @ M @ Z
    return T


def jacobian(X: Array, Z: Array, M: Array) -> Array:
    """(V, 6, 12) of the predicted T_camera_board, in axes of the camera, by the small changes of X and Z."""
    R_camera = X[:3, :3].T
    board = M[:, :3, :3] @ Z[:3, 3] + M[:, :3, 3]
    R_seen = R_camera @ M[:, :3, :3]
    J = np.zeros((len(M), 6, 12))
    J[:, :3, 0:3] = -R_camera
    J[:, :3, 3:6] = R_camera @ skew(board - X[:3, 3])
    J[:, 3:, 3:6] = -R_camera
    J[:, :3, 6:9] = R_seen
    J[:, 3:, 9:12] = R_seen
    return J


def refine(
    X: Array,
    Z: Array,
    M: Array,
    C: Array,
    noise: Noise,
    used: npt.NDArray[np.bool_],
    *,
    scale: float = 1.0,
    free_scale: bool = False,
    variances: Array | None = None,
) -> Fit:
    """Refine X, Z and the variances of the noise on the used views.

    Args:
        X: T_parent_camera (4, 4), start.
        Z: T_child_board (4, 4), start.
        M: T_parent_child (V, 4, 4).
        C: T_camera_board (V, 4, 4).
        noise: of the views.
        used: (V,) bool.
        scale: factor on the translations of C, start.
        free_scale: estimate it.
        variances: (K,) of a fit to nearly the same views, to start from.
    """
    first = np.maximum(first_variances(predict(X, Z, M), _scaled(C, scale), noise, used), noise.floors)
    # Never from the floor: a variance grows from there by factors, too slowly to be noticed.
    variances = first if variances is None else np.maximum(variances, _RESTART * first)
    A = np.zeros((13 if free_scale else 12,) * 2)
    for _ in range(_MAX_ITERATIONS):
        e, J = _linearise(X, Z, M, C, scale, free_scale)
        W = np.linalg.inv(np.einsum("k,kvij->vij", variances, noise.shapes))
        weight = huber_weights(np.sqrt(np.einsum("vi,vij,vj->v", e, W, e))) * used
        WJ = weight[:, None, None] * (W @ J)
        before, A = A, np.tensordot(J, WJ, axes=([0, 1], [0, 1]))
        step = _solve(A, np.tensordot(WJ, e, axes=([0, 1], [0, 1])))
        X, Z = change(X, step[:6]), change(Z, step[6:12])
        if free_scale:
            scale += step[12]
        variances = np.maximum(next_variances(variances, e, J, W, A, weight, noise), noise.floors)
        # The variances matter through the weights alone: one that fades away need not reach its end.
        if np.abs(step).max() < _CONVERGED and np.allclose(np.diag(A), np.diag(before), rtol=_CONVERGED_WEIGHTS):
            break
    return _leave_one_out(X, Z, M, C, scale, free_scale, variances, noise, used)


def reject_outliers(
    X: Array, Z: Array, M: Array, C: Array, noise: Noise, *, scale: float = 1.0, free_scale: bool = False
) -> Fit:
    """Refine on the views that agree: start from a wide gate, then drop and take back views until nothing changes.

    Args are those of `refine`, with X and Z from a consensus.
    """
    e = difference(_scaled(C, scale), predict(X, Z, M))
    sizes = np.linalg.norm(e.reshape(-1, 2, 3), axis=2)
    gates = np.maximum(_GATE * np.median(sizes, axis=0) / _CHI3_MEDIAN, 10 * FLOOR)
    used = (sizes < gates).all(axis=1)
    seen: set[bytes] = set()
    variances = None
    while True:
        fit = refine(X, Z, M, C, noise, used, scale=scale, free_scale=free_scale, variances=variances)
        keep = fit.distance < OUTLIER
        if (keep == used).all() or keep.sum() < 4 or keep.tobytes() in seen or len(seen) > _MAX_REJECTIONS:
            return fit
        seen.add(used.tobytes())
        X, Z, scale, used, variances = fit.X, fit.Z, fit.scale, keep, fit.variances


def _scaled(C: Array, scale: float) -> Array:
    scaled: Array = C.copy()
    scaled[:, :3, 3] *= scale
    return scaled


def _linearise(X: Array, Z: Array, M: Array, C: Array, scale: float, free_scale: bool) -> tuple[Array, Array]:
    """Disagreement (V, 6), and its Jacobian (V, 6, p) as that of the prediction minus what is seen."""
    e = difference(_scaled(C, scale), predict(X, Z, M))
    J = jacobian(X, Z, M)
    if free_scale:
        column = np.zeros((len(C), 6, 1))
        column[:, :3, 0] = -C[:, :3, 3]
        J = np.concatenate([J, column], axis=2)
    return e, J


def _solve(A: Array, b: Array) -> Array:
    """The shortest solution: directions that the views say nothing about are left alone."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(A, axis1=-2, axis2=-1), 1e-300))
    balanced = scale[..., :, None] * A * scale[..., None, :]
    return np.asarray(scale * (np.linalg.pinv(balanced, rcond=1e-12, hermitian=True) @ (scale * b)[..., None])[..., 0])


def _leave_one_out(
    X: Array,
    Z: Array,
    M: Array,
    C: Array,
    scale: float,
    free_scale: bool,
    variances: Array,
    noise: Noise,
    used: npt.NDArray[np.bool_],
) -> Fit:
    """Take each view's share out of the normal equations and make the Gauss-Newton step that follows."""
    e, J = _linearise(X, Z, M, C, scale, free_scale)
    S = np.einsum("k,kvij->vij", variances, noise.shapes)
    W = np.linalg.inv(S)
    weight = huber_weights(np.sqrt(np.einsum("vi,vij,vj->v", e, W, e))) * used
    JW = np.swapaxes(weight[:, None, None] * (W @ J), 1, 2)
    shares = JW @ J
    gradients = (JW @ e[..., None])[..., 0]
    without = shares.sum(axis=0) - shares
    steps = _solve(without, gradients.sum(axis=0) - gradients)
    held_X = change(np.broadcast_to(X, (len(M), 4, 4)), steps[:, :6])
    held_Z = change(np.broadcast_to(Z, (len(M), 4, 4)), steps[:, 6:12])
    held_e = e - np.einsum("vip,vp->vi", J, steps)
    spread = S + J @ np.linalg.pinv(without, hermitian=True) @ np.swapaxes(J, -1, -2)
    distance = np.sqrt(np.einsum("vi,vi->v", held_e, np.linalg.solve(spread, held_e[..., None])[..., 0]))
    covariance, uncertain_weights = kenward_roger(J, W, weight, noise.shapes)
    return Fit(X, Z, scale, variances, covariance, uncertain_weights, e, used, held_X, held_Z, distance)
