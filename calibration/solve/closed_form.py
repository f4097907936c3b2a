"""Hand-eye calibration in closed form: starting values for the refinement.

All solve M_i Z = X C_i for X = T_parent_camera and Z = T_child_board (see calibration.solve.views), with M_i the arm's
and C_i the camera's poses, (V, 4, 4) each. None of them weighs the noise; none is a result by itself.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.solve.se3 import invert, log, nearest_rotation, skew
from robotcell.geometry.transforms import Array, make_transform

if TYPE_CHECKING:
    from collections.abc import Callable

# Pairs of views that Park-Martin and Daniilidis look at: all of them for 60 views.
_MAX_PAIRS = 1770
# The axis of a smaller turn is noise, that of a larger one has an uncertain sign.
_MIN_TURN_RAD, _MAX_TURN_RAD = np.deg2rad(5), np.deg2rad(170)


def park_martin(M: Array, C: Array) -> tuple[Array, Array]:
    """X and Z (4, 4): rotation from the axes of relative motions (Park and Martin 1994), then translations.

    Raises:
        ValueError: fewer than two relative motions.
    """
    A, B = _relative_motions(M, C)
    R_X = nearest_rotation(np.einsum("ni,nj->ij", log(A[:, :3, :3]), log(B[:, :3, :3])))
    return _complete(R_X, M, C)


def daniilidis(M: Array, C: Array) -> tuple[Array, Array]:
    """X and Z (4, 4): rotation and translation together, by dual quaternions (Daniilidis 1999).

    Raises:
        ValueError: fewer than two relative motions, or all about one axis.
    """
    A, B = _relative_motions(M, C)
    a, a_dual = _dual_quaternions(A)
    b, b_dual = _dual_quaternions(B)
    # Both ends of a screw have the same real part; a quaternion and its negative are the same motion.
    sign = np.where((a[:, 0] * b[:, 0]) < 0, -1.0, 1.0)[:, None]
    b, b_dual = sign * b, sign * b_dual
    block = np.zeros((len(A), 6, 8))
    block[:, :3, 0] = block[:, 3:, 4] = (a - b)[:, 1:]
    block[:, :3, 1:4] = block[:, 3:, 5:] = skew((a + b)[:, 1:])
    block[:, 3:, 0] = (a_dual - b_dual)[:, 1:]
    block[:, 3:, 1:4] = skew((a_dual + b_dual)[:, 1:])
    # The null space is spanned by two vectors (u1, v1), (u2, v2); q = l1 u1 + l2 u2 must be a unit dual quaternion.
    null = np.linalg.svd(block.reshape(-1, 8), full_matrices=False)[2][-2:]
    (u1, v1), (u2, v2) = (np.split(vector, 2) for vector in null)
    ratios = np.roots([u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2])
    ratios = ratios[np.isfinite(ratios)].real
    if not len(ratios):
        raise ValueError("the motions leave the rotation undetermined")
    norms = [s * s * (u1 @ u1) + 2 * s * (u1 @ u2) + u2 @ u2 for s in ratios]
    best = int(np.argmax(norms))
    if norms[best] <= 0:
        raise ValueError("the motions leave the rotation undetermined")
    q = (ratios[best] * u1 + u2) / np.sqrt(norms[best])
    q_dual = (ratios[best] * v1 + v2) / np.sqrt(norms[best])
    w, x, y, z = q / np.linalg.norm(q)
    t_X = 2 * (q_dual[1:] * q[0] - q_dual[0] * q[1:] - np.cross(q_dual[1:], q[1:]))
    X = make_transform(Rotation.from_quat([x, y, z, w]).as_matrix(), t_X)
    Z = invert(M) @ X @ C
    return X, make_transform(nearest_rotation(Z[:, :3, :3].sum(axis=0)), np.median(Z[:, :3, 3], axis=0))


def shah(M: Array, C: Array) -> tuple[Array, Array]:
    """X and Z (4, 4): both rotations together by a Kronecker product (Shah 2013), then translations."""
    R_X, R_Z = shah_rotations(M[None, :, :3, :3], C[None, :, :3, :3])
    t_X, t_Z, _ = translations(R_X, M[None], C[None])
    return make_transform(R_X[0], t_X[0]), make_transform(R_Z[0], t_Z[0])


CLOSED_FORMS: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "Park-Martin": park_martin,
    "Daniilidis": daniilidis,
    "Shah": shah,
}


def shah_rotations(R_M: Array, R_C: Array) -> tuple[Array, Array]:
    """R_X and R_Z (S, 3, 3) of S sets of rotations (S, n, 3, 3)."""
    # vec(R_Z) = (R_M^T kron R_C^T) vec(R_X), row by row; the first singular pair of the sum agrees best with all.
    K = np.einsum("snji,snlk->sikjl", R_M, R_C).reshape(-1, 9, 9)
    U, _, Vt = np.linalg.svd(K)
    R_Z, R_X = U[:, :, 0].reshape(-1, 3, 3), Vt[:, 0].reshape(-1, 3, 3)
    sign = np.where(np.linalg.det(R_X) < 0, -1.0, 1.0)[:, None, None]
    return nearest_rotation(sign * R_X), nearest_rotation(sign * R_Z)


def translations(R_X: Array, M: Array, C: Array, *, free_scale: bool = False) -> tuple[Array, Array, Array]:
    """t_X, t_Z (S, 3) and the scale of the board (S,) of S sets, given R_X (S, 3, 3): linear least squares.

    Args:
        R_X: rotation of the camera.
        M: (S, n, 4, 4).
        C: (S, n, 4, 4).
        free_scale: the camera's translations are true up to a common factor; 1 otherwise.
    """
    sets, count = M.shape[:2]
    seen = np.einsum("sij,snj->sni", R_X, C[..., :3, 3])
    rows = np.zeros((sets, count, 3, 7))
    rows[..., :3] = np.eye(3)
    rows[..., 3:6] = -M[..., :3, :3]
    rows[..., 6] = seen
    known = M[..., :3, 3]
    if not free_scale:
        known, rows = known - seen, rows[..., :6]
    width = rows.shape[-1]
    unknowns = (np.linalg.pinv(rows.reshape(sets, -1, width)) @ known.reshape(sets, -1, 1))[..., 0]
    return unknowns[:, :3], unknowns[:, 3:6], unknowns[:, 6] if free_scale else np.ones(sets)


def _complete(R_X: Array, M: Array, C: Array) -> tuple[Array, Array]:
    t_X, t_Z, _ = translations(R_X[None], M[None], C[None])
    R_Z = nearest_rotation(np.einsum("nji,jk,nkl->il", M[:, :3, :3], R_X, C[:, :3, :3]))
    return make_transform(R_X, t_X[0]), make_transform(R_Z, t_Z[0])


def _relative_motions(M: Array, C: Array) -> tuple[Array, Array]:
    """A and B (n, 4, 4) with A X = X B, of pairs of views that turn by a useful angle."""
    pairs = np.array(list(combinations(range(len(M)), 2)))
    if len(pairs) < 2:
        raise ValueError("at least three views are needed")
    if len(pairs) > _MAX_PAIRS:
        pairs = np.random.default_rng(0).choice(pairs, _MAX_PAIRS, replace=False)
    A = M[pairs[:, 0]] @ invert(M[pairs[:, 1]])
    B = C[pairs[:, 0]] @ invert(C[pairs[:, 1]])
    angle = np.linalg.norm(log(A[:, :3, :3]), axis=1)
    useful = (angle > _MIN_TURN_RAD) & (angle < _MAX_TURN_RAD)
    return (A[useful], B[useful]) if useful.sum() >= 2 else (A, B)


def _dual_quaternions(T: Array) -> tuple[Array, Array]:
    """Real and dual part (n, 4), scalar first, of rigid motions."""
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    q = np.concatenate([xyzw[:, 3:], xyzw[:, :3]], axis=1)
    t = T[:, :3, 3]
    dual = np.empty_like(q)
    dual[:, 0] = -0.5 * np.einsum("ni,ni->n", t, q[:, 1:])
    dual[:, 1:] = 0.5 * (q[:, :1] * t + np.cross(t, q[:, 1:]))
    return q, dual
