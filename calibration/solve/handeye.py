"""Hand-eye calibration from poses: robust refinement in SE(3), with the noise estimated from the data.

The model is C_i = inv(X) M_i Z (see calibration.solve.views). A view's disagreement is six numbers in axes of the
camera: position of the board [m] and its turn [rad], seen minus predicted. Its covariance is a sum of known shapes with
unknown factors ("variance components"), which are estimated by restricted maximum likelihood together with X and Z; so
that the weight of a millimetre against a degree, and the covariance of the result, follow from the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from calibration.solve.rigid import change, difference, invert, skew

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

# 95 % of good views keep their full weight; the pull of the others no longer grows with their error (Huber 1964).
HUBER = float(np.sqrt(chi2.ppf(0.95, 6)))
# A good view is called an outlier once in ten thousand.
OUTLIER = float(np.sqrt(chi2.ppf(1 - 1e-4, 6)))
# Standard deviations are not estimated below a micrometre and a microradian: nothing mechanical is.
FLOOR = 1e-6
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
class Noise:
    """What the covariance of a view's disagreement is made of.

    Attributes:
        shapes: (K, V, 6, 6); the covariance of view i is the sum over k of variance k times shape (k, i).
        floors: (K,) smallest variances.
    """

    shapes: Array
    floors: Array


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


def pose_noise(C: Array) -> Noise:
    """Noise of poses that come without corners: across the view, along it, and turns about the same axes.

    A board's distance and tilt are seen several times worse than its place in the image and its turn about the axis.
    """
    shapes = np.zeros((4, len(C), 6, 6))
    for k, axes in enumerate(((0, 1), (2,), (3, 4), (5,))):
        for axis in axes:
            shapes[k, :, axis, axis] = 1.0
    return Noise(shapes, np.full(4, FLOOR**2))


def arm_noise(X: Array, M: Array, C: Array, *, on_the_arm: bool) -> Array:
    """Shapes (2, V, 6, 6) of an error of the flange's position and of its rotation, alike in all directions.

    Args:
        X: T_parent_camera (4, 4).
        M: T_parent_child (V, 4, 4).
        C: T_camera_board (V, 4, 4).
        on_the_arm: the arm carries the board (the flange is the child), not the camera.
    """
    flange = (M[:, :3, 3] if on_the_arm else np.zeros((len(M), 3))) - X[:3, 3]
    lever = C[:, :3, 3] - flange @ X[:3, :3]
    moved = np.concatenate([-skew(lever), np.broadcast_to(np.eye(3), (len(M), 3, 3))], axis=1)
    shapes = np.zeros((2, len(M), 6, 6))
    shapes[0, :, :3, :3] = np.eye(3)
    shapes[1] = moved @ np.swapaxes(moved, -1, -2)
    return shapes


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
    first = np.maximum(_first_variances(predict(X, Z, M), _scaled(C, scale), noise, used), noise.floors)
    # Never from the floor: a variance grows from there by factors, too slowly to be noticed.
    variances = first if variances is None else np.maximum(variances, _RESTART * first)
    A = np.zeros((13 if free_scale else 12,) * 2)
    for _ in range(_MAX_ITERATIONS):
        e, J = _linearise(X, Z, M, C, scale, free_scale)
        W = np.linalg.inv(np.einsum("k,kvij->vij", variances, noise.shapes))
        weight = _huber(np.sqrt(np.einsum("vi,vij,vj->v", e, W, e))) * used
        WJ = weight[:, None, None] * (W @ J)
        before, A = A, np.tensordot(J, WJ, axes=([0, 1], [0, 1]))
        step = _solve(A, np.tensordot(WJ, e, axes=([0, 1], [0, 1])))
        X, Z = change(X, step[:6]), change(Z, step[6:12])
        if free_scale:
            scale += step[12]
        variances = np.maximum(_next_variances(variances, e, J, W, A, weight, noise), noise.floors)
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


def _huber(distance: Array) -> Array:
    return np.asarray(np.minimum(1.0, HUBER / np.maximum(distance, 1e-12)))


def _first_variances(C_predicted: Array, C: Array, noise: Noise, used: npt.NDArray[np.bool_]) -> Array:
    """A start: each component alone explains the median disagreement in the directions that it acts in."""
    e = difference(C, C_predicted)
    shapes = noise.shapes[:, used]
    trace = np.einsum("kvij,kvji->kv", shapes, shapes).mean(axis=1)
    sizes = np.median(np.einsum("vi,kvij,vj->kv", e[used], shapes, e[used]), axis=1)
    return np.asarray(sizes / trace)


def _next_variances(variances: Array, e: Array, J: Array, W: Array, A: Array, weight: Array, noise: Noise) -> Array:
    """One step of the fixed point of restricted maximum likelihood (Harville 1977): e'PGPe / trace(PG) tends to one."""
    We = (W @ e[..., None])[..., 0]
    quadratic = np.einsum("v,vi,kvij,vj->k", weight, We, noise.shapes, We)
    taking_part = (weight > 0).astype(np.float64)
    WJ = W @ J
    lost = (noise.shapes @ WJ) * (weight[:, None, None] * WJ @ np.linalg.pinv(A, hermitian=True))
    trace = ((noise.shapes * W).sum(axis=(2, 3)) * taking_part).sum(axis=1) - lost.sum(axis=(1, 2, 3))
    return np.asarray(variances * quadratic / np.maximum(trace, 1e-12))


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
    weight = _huber(np.sqrt(np.einsum("vi,vij,vj->v", e, W, e))) * used
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
    covariance, uncertain_weights = _covariance(J, W, weight, noise.shapes)
    return Fit(X, Z, scale, variances, covariance, uncertain_weights, e, used, held_X, held_Z, distance)


def _covariance(J: Array, W: Array, weight: Array, shapes: Array) -> tuple[Array, Array]:
    """Covariance (p, p), and the part of it due to estimated variances (Kenward and Roger 1997).

    Args:
        J: (V, 6, p) Jacobian.
        W: (V, 6, 6) inverse covariance of each view's disagreement.
        weight: (V,) of each view.
        shapes: (K, V, 6, 6) of the noise.
    """
    WJ = weight[:, None, None] * (W @ J)
    weighted = weight[:, None, None] * W
    simple = np.linalg.pinv(np.tensordot(J, WJ, axes=([0, 1], [0, 1])), hermitian=True)
    GWJ, GW = shapes @ WJ, shapes @ weighted
    P = np.tensordot(WJ, GWJ, axes=([0, 1], [1, 2])).transpose(1, 0, 2)
    Q = np.tensordot(GWJ, weighted @ GWJ, axes=([1, 2], [1, 2])).transpose(0, 2, 1, 3)
    PP = P[:, None] @ simple @ P[None]
    fisher = np.einsum("kvij,lvji->kl", GW, GW) - 2 * (Q * simple).sum(axis=(2, 3)) + (PP * simple).sum(axis=(2, 3))
    spread = 2 * np.linalg.pinv(fisher, hermitian=True)
    extra = 2 * simple @ np.tensordot(spread, Q - PP, axes=2) @ simple
    return np.asarray(simple + extra), np.asarray(extra)
