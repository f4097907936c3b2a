"""Poses as a UR controller writes them: position [m] and rotation vector [rad], six numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

from robotcell.geometry.transforms import make_transform, rotvec_to_matrix

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.interfaces import Array

Pose: TypeAlias = tuple[float, float, float, float, float, float]

ZERO_POSE: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def pose_to_matrix(pose: Sequence[float]) -> Array:
    """The (4, 4) transform of a pose."""
    return make_transform(rotvec_to_matrix(pose[3:6]), pose[:3])


def matrix_to_pose(T: Array) -> Pose:
    """The pose of a (4, 4) transform."""
    x, y, z = T[:3, 3].tolist()
    return (x, y, z, *rotation_vector(T[:3, :3]))


def rotation_vector(R: Array) -> tuple[float, float, float]:
    """The rotation vector [rad] of a (3, 3) rotation matrix.

    Several are asked for in every control period; `geometry.matrix_to_rotvec` takes twenty times as long.
    Shepperd's method: the quaternion, starting from its largest part.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
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
        return 0.0, 0.0, 0.0
    scale = 2 * math.atan2(sine, w) / sine
    return x * scale, y * scale, z * scale


def displaced(T: Array, displacement: Array) -> Array:
    """A transform (4, 4) after a displacement (6,) [m, rad] in base axes: the origin moves, the axes turn about it."""
    moved: Array = T.copy()
    moved[:3, 3] += displacement[:3]
    moved[:3, :3] = rotvec_to_matrix(displacement[3:]) @ T[:3, :3]
    return moved
