"""Bundle adjustment over corner pixels: camera, board, what the arm's poses are off by, and on request the intrinsics.

A corner of view i is predicted at project(inv(X) M_i(a_i) Z p). The arm's pose is off by a small change a_i of the
flange, which is held near zero by the arm's noise; its standard deviations, and that of a corner, are estimated from
the data before (calibration.solve.variance_components). The a_i are eliminated from the normal equations (Schur
complement), so a step costs little more than reading the corners, and leaving one view out is a step with that view's
share taken out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.projection import INTRINSICS, CornerStack, project
from calibration.solve.robust_weights import corner_weights, huber_weights
from calibration.solve.se3 import change, exp, skew

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.geometry.transforms import Array

_MAX_ITERATIONS = 50
_CONVERGED = 1e-8
_MAX_HALVINGS = 8
# What is known of intrinsics before any picture: focal length and principal point to 3 % of the image's width, and
# a lens that is no fisheye. Wide enough to leave a real estimate alone; they hold what the views say nothing about.
_PRIOR_SHARE = 0.03
_PRIOR_DISTORTION = (0.3, 0.5, 0.01, 0.01, 0.5)


@dataclass(frozen=True)
class BundleNoise:
    """Standard deviations that the bundle weighs with.

    Attributes:
        corner_px: of a corner's coordinate, with errors that the corners of a view share.
        position_m: of the flange's position.
        rotation_rad: of the flange's rotation.
    """

    corner_px: float
    position_m: float
    rotation_rad: float


@dataclass(frozen=True)
class Bundle:
    """What the bundle found.

    Attributes:
        X: T_parent_camera (4, 4).
        Z: T_child_board (4, 4), the board's origin is the mean of its corners.
        intrinsics: (9,) fx fy cx cy k1 k2 p1 p2 k3.
        arm: (V, 6) small change of each flange pose, in axes of the flange.
        information: (p, p) of the small changes of X and Z and, where refined, of the intrinsics.
        X_held_out: (V, 4, 4) X as solved without the view.
        Z_held_out: (V, 4, 4) likewise.
        intrinsics_held_out: (V, 9) likewise.
    """

    X: Array
    Z: Array
    intrinsics: Array
    arm: Array
    information: Array
    X_held_out: Array
    Z_held_out: Array
    intrinsics_held_out: Array

    @property
    def covariance(self) -> Array:
        """(6, 6) of the small change of X."""
        return np.asarray(np.linalg.inv(self.information)[:6, :6])


@dataclass(frozen=True)
class _Problem:
    stack: CornerStack
    M: Array
    noise: BundleNoise
    on_the_arm: bool
    prior: Array
    prior_weight: Array

    @property
    def unknowns(self) -> int:
        return 12 + (INTRINSICS if self.prior_weight.any() else 0)


@dataclass(frozen=True)
class _State:
    X: Array
    Z: Array
    intrinsics: Array
    arm: Array

    def moved(self, common: Array, arm: Array) -> _State:
        intrinsics = self.intrinsics + common[12:] if len(common) > 12 else self.intrinsics
        return _State(change(self.X, common[:6]), change(self.Z, common[6:12]), intrinsics, self.arm + arm)


def solve_bundle(
    stack: CornerStack,
    M: Array,
    noise: BundleNoise,
    X: Array,
    Z: Array,
    intrinsics: Array,
    *,
    on_the_arm: bool,
    width: int | None = None,
) -> Bundle:
    """Minimise the reprojection error of all corners together.

    Args:
        stack: corners of the V views that take part.
        M: T_parent_child (V, 4, 4).
        noise: of corners and arm.
        X: T_parent_camera (4, 4), start.
        Z: T_child_board (4, 4), start; the board's origin is the mean of its corners.
        intrinsics: (9,) as given.
        on_the_arm: the arm carries the board (the flange is the child), not the camera.
        width: of the image [px], to refine the intrinsics; None keeps them as given.
    """
    weight = np.zeros(INTRINSICS)
    if width is not None:
        weight[:4] = 1 / (_PRIOR_SHARE * width) ** 2
        weight[4:] = 1 / np.array(_PRIOR_DISTORTION) ** 2
    problem = _Problem(stack, M, noise, on_the_arm, intrinsics, weight)
    state = _State(X, Z, intrinsics, np.zeros((len(M), 6)))
    cost = _cost(problem, state)
    for _ in range(_MAX_ITERATIONS):
        shares, gradients, back = _normal_equations(problem, state)
        A, b = _with_prior(problem, state, shares.sum(axis=0), gradients.sum(axis=0))
        common = _balanced_solve(A, b)
        arm = back(common)
        factor, candidate = 1.0, state.moved(common, arm)
        candidate_cost = _cost(problem, candidate)
        for _ in range(_MAX_HALVINGS):
            if candidate_cost <= cost * (1 + 1e-12):
                break
            factor /= 2
            candidate = state.moved(factor * common, factor * arm)
            candidate_cost = _cost(problem, candidate)
        else:
            break
        state, cost = candidate, candidate_cost
        if np.abs(common[:12]).max() < _CONVERGED:
            break
    return _leave_one_out(problem, state)


def _carried(problem: _Problem, state: _State) -> tuple[Array, Array]:
    """Corners in the parent frame (V, K, 3), and their derivatives (V, K, 3, 6) by the arm's changes."""
    d, turn = state.arm[:, None, :3], exp(state.arm[:, 3:])
    R_M, t_M = problem.M[:, :3, :3], problem.M[:, None, :3, 3]
    on_child = problem.stack.points @ state.Z[:3, :3].T + state.Z[:3, 3]
    if problem.on_the_arm:
        turned = on_child @ np.swapaxes(turn, 1, 2)
        carried = (turned + d) @ np.swapaxes(R_M, 1, 2) + t_M
        by_arm = R_M[:, None] @ np.concatenate([_identities(turned), -skew(turned)], axis=-1)
    else:
        turned = (on_child @ np.swapaxes(R_M, 1, 2) + t_M) @ np.swapaxes(turn, 1, 2)
        carried = turned + d
        by_arm = np.concatenate([_identities(turned), -skew(turned)], axis=-1)
    return carried, by_arm


def _identities(vectors: Array) -> Array:
    return np.broadcast_to(np.eye(3), (*vectors.shape, 3))


def _residuals(problem: _Problem, state: _State) -> Array:
    carried, _ = _carried(problem, state)
    px, _, _ = project((carried - state.X[:3, 3]) @ state.X[:3, :3], state.intrinsics, derivatives=False)
    return problem.stack.px - px


def _arm_weights(problem: _Problem, state: _State) -> tuple[Array, Array, Array]:
    """Inverse variances (6,) of the arm's changes, Huber weight (V,) of each view's, and its distance (V,)."""
    noise = problem.noise
    inverse = np.repeat([1 / noise.position_m**2, 1 / noise.rotation_rad**2], 3)
    distance = np.sqrt((state.arm**2 * inverse).sum(axis=1))
    return inverse, huber_weights(distance), distance


def _cost(problem: _Problem, state: _State) -> float:
    """Twice the negative log likelihood, up to a constant, with Huber's function for corners and for the arm."""
    residual = _residuals(problem, state)
    size = np.linalg.norm(residual, axis=-1) / problem.noise.corner_px
    weight = corner_weights(residual, problem.stack.seen, problem.noise.corner_px)
    _, arm_weight, distance = _arm_weights(problem, state)
    # Huber's function is w (2 - w) r^2 with its own weight w.
    corners = (weight * (2 - weight) * size**2 * problem.stack.seen).sum()
    arm = (arm_weight * (2 - arm_weight) * distance**2).sum()
    prior = ((state.intrinsics - problem.prior) ** 2 * problem.prior_weight).sum()
    return float(corners + arm + prior)


def _normal_equations(problem: _Problem, state: _State) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Each view's share of the normal equations of the common unknowns, the arm's changes eliminated.

    Returns:
        shares (V, p, p), gradients (V, p), and the function that gives the arm's steps (V, 6) for a common step (p,).
    """
    residual, J, J_arm = _linearise(problem, state)
    views, rows = len(residual), 2 * residual.shape[1]
    weight = corner_weights(residual, problem.stack.seen, problem.noise.corner_px) / problem.noise.corner_px**2
    root = np.repeat(np.sqrt(weight), 2, axis=1)[..., None]
    r = root[..., 0] * residual.reshape(views, rows)
    J, J_arm = root * J.reshape(views, rows, -1), root * J_arm.reshape(views, rows, 6)
    J_t, J_arm_t = np.swapaxes(J, 1, 2), np.swapaxes(J_arm, 1, 2)
    inverse, arm_weight, _ = _arm_weights(problem, state)
    held = arm_weight[:, None] * inverse
    H = J_arm_t @ J_arm + held[:, None, :] * np.eye(6)
    mixed = J_arm_t @ J
    b = (J_t @ r[..., None])[..., 0]
    b_arm = (J_arm_t @ r[..., None])[..., 0] - held * state.arm
    eliminated = np.linalg.solve(H, np.concatenate([mixed, b_arm[..., None]], axis=2))
    mixed_t = np.swapaxes(mixed, 1, 2)
    shares = J_t @ J - mixed_t @ eliminated[..., :-1]
    gradients = b - (mixed_t @ eliminated[..., -1:])[..., 0]
    return shares, gradients, lambda common: eliminated[..., -1] - eliminated[..., :-1] @ common


def _linearise(problem: _Problem, state: _State) -> tuple[Array, Array, Array]:
    """Residuals (V, K, 2), derivatives of the prediction by common unknowns (V, K, 2, p) and the arm's (V, K, 2, 6)."""
    carried, by_arm = _carried(problem, state)
    from_camera = carried - state.X[:3, 3]
    px, by_point, by_intrinsics = project(from_camera @ state.X[:3, :3], state.intrinsics)
    by_parent = by_point @ state.X[:3, :3].T
    turn, R_M = exp(state.arm[:, 3:]), problem.M[:, :3, :3]
    by_child = by_parent @ (R_M @ turn if problem.on_the_arm else turn @ R_M)[:, None]
    J = np.empty((*px.shape, problem.unknowns))
    J[..., 0:3] = -by_parent
    J[..., 3:6] = by_parent @ skew(from_camera)
    J[..., 6:9] = by_child
    J[..., 9:12] = -by_child @ skew(problem.stack.points @ state.Z[:3, :3].T)
    if problem.unknowns > 12:
        J[..., 12:] = by_intrinsics
    return problem.stack.px - px, J, by_parent @ by_arm


def _with_prior(problem: _Problem, state: _State, A: Array, b: Array) -> tuple[Array, Array]:
    """Add what is known of the intrinsics beforehand to normal equations (..., p, p) and (..., p)."""
    if problem.unknowns > 12:
        A, b = A.copy(), b.copy()
        A[..., 12:, 12:] += np.diag(problem.prior_weight)
        b[..., 12:] += problem.prior_weight * (problem.prior - state.intrinsics)
    return A, b


def _balanced_solve(A: Array, b: Array) -> Array:
    """Solve (..., p, p) with (..., p) in unknowns of like size: metres, radians and pixels are far apart."""
    scale = 1 / np.sqrt(np.diagonal(A, axis1=-2, axis2=-1))
    balanced = scale[..., :, None] * A * scale[..., None, :]
    return np.asarray(scale * np.linalg.solve(balanced, (scale * b)[..., None])[..., 0])


def _leave_one_out(problem: _Problem, state: _State) -> Bundle:
    shares, gradients, _ = _normal_equations(problem, state)
    A, b = shares.sum(axis=0), gradients.sum(axis=0)
    steps = _balanced_solve(*_with_prior(problem, state, A - shares, b - gradients))
    count = len(steps)
    return Bundle(
        state.X,
        state.Z,
        state.intrinsics,
        state.arm,
        _with_prior(problem, state, A, b)[0],
        change(np.broadcast_to(state.X, (count, 4, 4)), steps[:, :6]),
        change(np.broadcast_to(state.Z, (count, 4, 4)), steps[:, 6:12]),
        state.intrinsics + (steps[:, 12:] if problem.unknowns > 12 else np.zeros((count, INTRINSICS))),
    )
