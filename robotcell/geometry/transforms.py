"""Rigid transforms and angles.

`T_a_b` is a (4, 4) float64 matrix that maps points in frame b to frame a (the pose of b in a). Metres, radians.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from robotcell.interfaces import Array

if TYPE_CHECKING:
    import numpy.typing as npt

__all__ = [
    "Array",
    "check_transform",
    "cross",
    "interpolate_transforms",
    "invert_transform",
    "look_at",
    "make_transform",
    "matrix_to_rotvec",
    "rotation_angle",
    "rotation_z",
    "rotvec_to_matrix",
    "transform_points",
]

# How far R R^T may be from the identity; single-precision files and printed digits stay below it.
_ROTATION_TOLERANCE = 1e-4


def make_transform(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    """The (4, 4) transform of a (3, 3) rotation matrix and a (3,) translation [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def check_transform(T: npt.ArrayLike, name: str) -> Array:
    """Return `T` as a (4, 4) float64 array if it is a right-handed rigid transform.

    Raises:
        ValueError: naming the transform and what is wrong with it.
    """
    matrix = np.asarray(T, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"{name} has shape {matrix.shape}; a 4x4 matrix is needed")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} contains NaN or infinity")
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError(f"{name} has the last row {matrix[3].tolist()}; it must be 0 0 0 1")
    R = matrix[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE):
        raise ValueError(f"{name} is not rigid: its rotation part is not orthonormal")
    if np.linalg.det(R) < 0:
        raise ValueError(f"{name} is mirrored: its rotation part has determinant -1")
    return matrix


def invert_transform(T: Array) -> Array:
    """`T_b_a` from `T_a_b`."""
    R = T[:3, :3]
    return make_transform(R.T, -R.T @ T[:3, 3])


def transform_points(T_a_b: Array, points_b: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Map (..., 3) points in frame b to frame a [m]."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def rotation_z(angle: float) -> Array:
    """The (3, 3) rotation by `angle` [rad] about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


# The next two are a line each with SciPy's Rotation. It takes twenty times as long on one rotation, which supervision
# asks for in every period; and to import it takes longer than all the rest that a driver's process imports.


def rotvec_to_matrix(rotvec: npt.ArrayLike) -> Array:
    """The (..., 3, 3) rotation matrices of (..., 3) rotation vectors [rad], by Rodrigues' formula."""
    v = np.asarray(rotvec, dtype=np.float64)
    angle = np.sqrt((v * v).sum(axis=-1))[..., None, None]
    K = np.zeros((*v.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    K -= np.swapaxes(K, -1, -2)
    # sin(a) / a and (1 - cos(a)) / a^2, both exact at 0. np.sinc(x) is sin(pi x) / (pi x).
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (K @ K))


def matrix_to_rotvec(rotation: Array) -> Array:
    """The (3,) rotation vector [rad] of a (3, 3) rotation matrix.

    Shepperd's method (1978): the quaternion, starting from its largest part.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    trace = a + e + i
    if trace > max(a, e, i):
        w, x, y, z = 1 + trace, h - f, c - g, d - b
    elif a >= e and a >= i:
        w, x, y, z = h - f, 1 + a - e - i, b + d, c + g
    elif e >= i:
        w, x, y, z = c - g, b + d, 1 + e - a - i, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1 + i - a - e
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0:
        return np.zeros(3)
    return np.array((x, y, z)) * (2 * math.atan2(sine, w) / sine)


def rotation_angle(R_a: Array, R_b: Array) -> float:
    """The angle [rad] of the rotation between two (3, 3) rotation matrices."""
    return math.hypot(*matrix_to_rotvec(R_a.T @ R_b).tolist())


def cross(a: Array, b: Array) -> Array:
    """A x b of (..., 3), several times faster than np.cross on few numbers; supervision needs it in every period."""
    once, twice = [1, 2, 0], [2, 0, 1]
    return a[..., once] * b[..., twice] - a[..., twice] * b[..., once]


def interpolate_transforms(T_start: Array, T_end: Array, fractions: npt.ArrayLike) -> Array:
    """Transforms (N, 4, 4) on the straight line, with slerp for the rotation, at (N,) fractions in [0, 1]."""
    s = np.atleast_1d(np.asarray(fractions, dtype=np.float64))
    T = np.tile(np.eye(4), (len(s), 1, 1))
    T[:, :3, 3] = T_start[:3, 3] + s[:, None] * (T_end[:3, 3] - T_start[:3, 3])
    turn = matrix_to_rotvec(T_start[:3, :3].T @ T_end[:3, :3])
    T[:, :3, :3] = T_start[:3, :3] @ rotvec_to_matrix(s[:, None] * turn)
    return T


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike) -> Array:
    """`T_base_camera` (OpenCV axes: x right, y down, z forward) of a camera at `eye` that looks at `target` [m].

    The image's up direction is base +z, or base +x when the camera looks straight up or down.

    Raises:
        ValueError: if eye and target coincide.
    """
    eye, target = np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = target - eye
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise ValueError("the camera's position and the point it looks at coincide")
    forward = forward / distance
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 1 - 1e-9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return make_transform(np.column_stack([right, down, forward]), eye)
