"""Stacks of rigid transforms and their small changes.

A small change of a transform T = [R, t] is six numbers (d, w): d [m] moves it and w [rad] turns it, both in axes of its
parent frame: exp(w) R, t + d. Every Jacobian and covariance of this package is in these coordinates.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array


def invert(T: Array) -> Array:
    """The inverses (..., 4, 4) of rigid transforms."""
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = R_inverse
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", R_inverse, T[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def exp(rotvec: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    flat = rotvec.reshape(-1, 3)
    return np.asarray(Rotation.from_rotvec(flat).as_matrix()).reshape(*rotvec.shape[:-1], 3, 3)


def log(R: Array) -> Array:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3)."""
    flat = R.reshape(-1, 3, 3)
    return np.asarray(Rotation.from_matrix(flat).as_rotvec()).reshape(*R.shape[:-2], 3)


def skew(v: Array) -> Array:
    """The matrices (..., 3, 3) that take a vector a to the cross product v x a."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack(
        [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)],
        -2,
    )


def change(T: Array, delta: Array) -> Array:
    """Transforms (..., 4, 4) after small changes (..., 6)."""
    R = exp(delta[..., 3:]) @ T[..., :3, :3]
    changed = np.zeros((*R.shape[:-2], 4, 4))
    changed[..., :3, :3] = R
    changed[..., :3, 3] = T[..., :3, 3] + delta[..., :3]
    changed[..., 3, 3] = 1.0
    return changed


def difference(T: Array, T_reference: Array) -> Array:
    """The changes (..., 6) that bring `T_reference` to `T`."""
    R = T[..., :3, :3] @ np.swapaxes(T_reference[..., :3, :3], -1, -2)
    return np.concatenate([T[..., :3, 3] - T_reference[..., :3, 3], log(R)], axis=-1)


def nearest_rotation(matrix: Array) -> Array:
    """The rotations (..., 3, 3) nearest to matrices in the Frobenius norm; their determinant is +1."""
    U, _, Vt = np.linalg.svd(matrix)
    sign = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return np.asarray(U @ Vt)
