"""Poses as a UR controller writes them: position [m] and rotation vector [rad], six numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from robotcell.geometry.transforms import make_transform, matrix_to_rotvec, rotvec_to_matrix

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
    return (x, y, z, *matrix_to_rotvec(T[:3, :3]).tolist())


def displaced(T: Array, displacement: Array) -> Array:
    """A transform (4, 4) after a displacement (6,) [m, rad] in base axes: the origin moves, the axes turn about it."""
    moved: Array = T.copy()
    moved[:3, 3] += displacement[:3]
    moved[:3, :3] = rotvec_to_matrix(displacement[3:]) @ T[:3, :3]
    return moved
