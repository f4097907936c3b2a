"""Kinematics of the UR5e in the controller's base frame (z up, the arm reaches along -x at q0 = 0).

Nominal Denavit-Hartenberg values, as Universal Robots publishes them for the UR5e. A real arm's own calibration
differs by up to a few millimetres: on hardware the controller's tcp pose is the truth, and this model plans and checks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from ur_analytic_ik import ur5e as analytic_ik

from robotcell.geometry.transforms import cross, rotation_z

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

DH_A = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
DH_D = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
DH_ALPHA = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])

# Universal Robots, UR5e user manual: every joint turns by +-360 degrees at up to 180 degrees/s; the elbow, by the
# arm's own links, by +-180. The maxima are the ranges that the RTDE control interface accepts.
JOINT_LIMIT = np.array([2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi])
MAX_JOINT_SPEED = 3.14
MAX_JOINT_ACCELERATION = 40.0
MAX_TOOL_SPEED = 3.0
MAX_TOOL_ACCELERATION = 150.0


def link_frames(q: npt.ArrayLike) -> Array:
    """Frames of the base and of the six links.

    Args:
        q: (..., 6) joint angles [rad].

    Returns:
        (..., 7, 4, 4): T_base_link for the base and the DH frames 1..6; the last one is the flange.
    """
    q = np.asarray(q, dtype=np.float64)
    c, s = np.cos(q), np.sin(q)
    ca, sa = np.cos(DH_ALPHA), np.sin(DH_ALPHA)
    A = np.zeros((*q.shape, 4, 4))
    A[..., 0, 0], A[..., 0, 1], A[..., 0, 2], A[..., 0, 3] = c, -s * ca, s * sa, DH_A * c
    A[..., 1, 0], A[..., 1, 1], A[..., 1, 2], A[..., 1, 3] = s, c * ca, -c * sa, DH_A * s
    A[..., 2, 1], A[..., 2, 2], A[..., 2, 3] = sa, ca, DH_D
    A[..., 3, 3] = 1.0
    frames = np.empty((*q.shape[:-1], 7, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    for i in range(6):
        frames[..., i + 1, :, :] = frames[..., i, :, :] @ A[..., i, :, :]
    return frames


def forward(q: npt.ArrayLike) -> Array:
    """T_base_flange (..., 4, 4) of joint angles (..., 6) [rad]."""
    return link_frames(q)[..., 6, :, :]


def jacobian(q: npt.ArrayLike) -> Array:
    """Geometric Jacobian (..., 6, 6) of the flange in base axes: rows 0-2 m/rad, rows 3-5 rad/rad."""
    frames = link_frames(q)
    axes = frames[..., :6, :3, 2]
    arms = frames[..., 6, None, :3, 3] - frames[..., :6, :3, 3]
    return np.concatenate([np.swapaxes(cross(axes, arms), -1, -2), np.swapaxes(axes, -1, -2)], axis=-2)


def tool_speed(q: npt.ArrayLike, qd: npt.ArrayLike, tool_length_m: float) -> npt.NDArray[np.float64]:
    """Speed (...,) [m/s] of the point `tool_length_m` before the flange, of joint speeds (..., 6) [rad/s]."""
    frames = link_frames(q)
    point = frames[..., 6, :3, 3] + tool_length_m * frames[..., 6, :3, 2]
    speeds = cross(frames[..., :6, :3, 2], point[..., None, :] - frames[..., :6, :3, 3])
    return np.asarray(np.linalg.norm(np.einsum("...ji,...j->...i", speeds, np.asarray(qd, dtype=np.float64)), axis=-1))


def distance_to_singularity(q: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Smallest singular value of the Jacobian (...,), rows of metres and radians alike; 0 at a singularity."""
    return np.asarray(np.linalg.svd(jacobian(q), compute_uv=False)[..., -1])


def inverse(T_base_flange: Array, q_near: npt.ArrayLike) -> Array | None:
    """The joint angles (6,) [rad] that reach a flange pose and are nearest to `q_near` (largest joint difference).

    Every solution is taken in the turn nearest to `q_near` that lies within the joint limits. None if the pose is
    out of reach.
    """
    near = np.asarray(q_near, dtype=np.float64)
    q = _nearest(T_base_flange, near)
    if q is not None and np.abs(q - near).max() < _NEAR:
        return q
    # The solver loses a solution whose last joint stands within 1e-12 of zero: look once more with that joint turned.
    T = np.asarray(T_base_flange, dtype=np.float64).copy()
    T[:3, :3] = T[:3, :3] @ rotation_z(_TURN)
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, _TURN])
    turned = _nearest(T, near + turn)
    if turned is None:
        return q
    turned = turned - turn
    return turned if q is None or np.abs(turned - near).max() < np.abs(q - near).max() else q


def inverse_all(T_base_flange: Array, q_near: npt.ArrayLike) -> Array:
    """All joint angles (N, 6) [rad] that reach a flange pose, those nearest to `q_near` first.

    Every solution is taken in the turn nearest to `q_near` that lies within the joint limits.
    """
    near = np.asarray(q_near, dtype=np.float64)
    q = _within_limits(T_base_flange, near)
    return np.asarray(q[np.argsort(np.abs(q - near).max(axis=1), kind="stable")])


def inverse_along(T_base_flange: Array, q_start: npt.ArrayLike, max_step: float) -> Array:
    """Joint angles along a flange path, each nearest to the one before.

    Args:
        T_base_flange: (N, 4, 4) poses.
        q_start: (6,) joint angles [rad] before the first pose.
        max_step: the largest joint difference [rad] between neighbours that still counts as continuous.

    Returns:
        (N, 6) [rad].

    Raises:
        ValueError: a pose is out of reach, or the path crosses a singularity; the message says where.
    """
    path = np.empty((len(T_base_flange), 6))
    q = np.asarray(q_start, dtype=np.float64)
    for i, T in enumerate(T_base_flange):
        solution = inverse(T, q)
        where = "x {:.3f}, y {:.3f}, z {:.3f} m".format(*T[:3, 3])
        if solution is None:
            raise ValueError(f"the flange cannot reach {where}")
        step = float(np.abs(solution - q).max())
        if step > max_step:
            raise ValueError(f"the path passes a singularity at flange {where}: a joint would jump by {step:.2f} rad")
        path[i] = q = solution
    return path


# A solution this near [rad] to where the arm is need not be looked for twice.
_NEAR = 0.3
_TURN = 1e-3


def _nearest(T_base_flange: Array, near: Array) -> Array | None:
    """The solver's solution within the joint limits that is nearest to `near` (6,), None if there is none."""
    q = _within_limits(T_base_flange, near)
    return np.asarray(q[np.argmin(np.abs(q - near).max(axis=1))]) if len(q) else None


def _within_limits(T_base_flange: Array, near: Array) -> Array:
    """The solver's solutions (N, 6) within the joint limits, each in its turn nearest to `near` (6,)."""
    solutions = analytic_ik.inverse_kinematics(np.ascontiguousarray(T_base_flange, dtype=np.float64))
    if not solutions:
        return np.empty((0, 6))
    q = np.asarray(solutions)
    q = q + 2 * np.pi * np.round((near - q) / (2 * np.pi))
    q = np.where(q > JOINT_LIMIT, q - 2 * np.pi, q)
    q = np.where(q < -JOINT_LIMIT, q + 2 * np.pi, q)
    return np.asarray(q[(np.abs(q) <= JOINT_LIMIT).all(axis=1)])
