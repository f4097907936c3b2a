"""What a UR5e's controller would refuse, or could not do: refused by us before anything is sent."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import check_transform, interpolate_transforms, invert_transform, rotation_angle

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

# Two neighbouring samples of a line that differ by more than this are different configurations of the arm.
BRANCH_STEP_RAD = 0.3
_LINE_STEP_M = 0.005
_LINE_STEP_RAD = 0.03

_T_TCP_FLANGE = invert_transform(rg2.T_FLANGE_TCP)


def check_joint_motion(q: npt.ArrayLike, speed_rad_s: float, acceleration_rad_s2: float) -> Array:
    """The target as an array (6,) [rad].

    Raises:
        UnsafeMotion: it is not six finite angles within the joint limits, or speed or acceleration are outside the
            controller's range.
    """
    target = np.asarray(q, dtype=np.float64)
    if target.shape != (6,) or not np.isfinite(target).all():
        raise UnsafeMotion(f"joint target {q!r}: six finite angles are needed")
    if (np.abs(target) > ur5e.JOINT_LIMIT).any():
        joint = int(np.argmax(np.abs(target) - ur5e.JOINT_LIMIT))
        limit = ur5e.JOINT_LIMIT[joint]
        raise UnsafeMotion(f"joint {joint + 1} is sent to {target[joint]:.3f} rad; its limit is {limit:.3f}")
    _check_range("speed", speed_rad_s, ur5e.MAX_JOINT_SPEED, "rad/s")
    _check_range("acceleration", acceleration_rad_s2, ur5e.MAX_JOINT_ACCELERATION, "rad/s^2")
    return target


def check_linear_motion(T_base_tcp: npt.ArrayLike, speed_m_s: float, acceleration_m_s2: float) -> Array:
    """The target as an array (4, 4).

    Raises:
        UnsafeMotion: it is no rigid transform, or speed or acceleration are outside the controller's range.
    """
    try:
        target = check_transform(T_base_tcp, "T_base_tcp")
    except ValueError as error:
        raise UnsafeMotion(str(error)) from None
    _check_range("speed", speed_m_s, ur5e.MAX_TOOL_SPEED, "m/s")
    _check_range("acceleration", acceleration_m_s2, ur5e.MAX_TOOL_ACCELERATION, "m/s^2")
    return target


def check_line(q: Array, T_start: Array, T_goal: Array, speed_m_s: float) -> None:
    """Check a straight motion of the tcp by the nominal kinematics.

    Args:
        q: (6,) measured joint angles [rad].
        T_start: T_base_tcp (4, 4) measured.
        T_goal: T_base_tcp (4, 4) at the end.
        speed_m_s: of the tcp.

    Raises:
        UnsafeMotion: a pose on the way is out of reach or singular, or a joint would have to turn faster than it can.
    """
    length = float(np.linalg.norm(T_goal[:3, 3] - T_start[:3, 3]))
    turn = rotation_angle(T_start[:3, :3], T_goal[:3, :3])
    count = max(math.ceil(max(length / _LINE_STEP_M, turn / _LINE_STEP_RAD)), 1) + 1
    poses = interpolate_transforms(T_start, T_goal, np.linspace(0.0, 1.0, count)) @ _T_TCP_FLANGE
    try:
        path = ur5e.inverse_along(poses, q, BRANCH_STEP_RAD)
    except ValueError as error:
        raise UnsafeMotion(f"straight motion refused: {error}") from None
    # A turn on the spot is as slow as the controller makes it.
    if length > 0:
        step_s = length / (count - 1) / speed_m_s
        check_joint_speeds(np.abs(np.diff(path, axis=0)) / step_s)


def check_joint_speeds(speeds: Array) -> None:
    """Check the joint speeds (N, 6) [rad/s] along a straight motion.

    Raises:
        UnsafeMotion: a joint would have to turn faster than it can.
    """
    if speeds.max() > ur5e.MAX_JOINT_SPEED:
        joint = int(np.argmax(speeds.max(axis=0)))
        raise UnsafeMotion(
            f"straight motion refused: joint {joint + 1} would have to turn at {speeds.max():.1f} rad/s, its "
            f"limit is {ur5e.MAX_JOINT_SPEED:.2f}; go slower, or keep away from the singularity"
        )


def _check_range(what: str, value: float, high: float, unit: str) -> None:
    if not math.isfinite(value) or not 0 < value <= high:
        raise UnsafeMotion(f"{what} {value} {unit} is outside the controller's range of above 0 to {high:g} {unit}")
