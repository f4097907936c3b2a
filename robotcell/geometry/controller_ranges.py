"""The ranges that a UR5e's controller takes: arguments outside them are refused before anything is sent."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import UnsafeMotion
from robotcell.geometry import ur5e
from robotcell.geometry.transforms import check_transform
from robotcell.interfaces import JointWaypoint, LinearWaypoint

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Waypoint

# No corner is rounded further away from it; also no path of more legs is taken. Ours, not the controller's.
_MAX_BLEND_M = 2.0
_MAX_LEGS = 100


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


def check_path_motion(waypoints: Sequence[Waypoint]) -> tuple[Waypoint, ...]:
    """The waypoints, their targets as arrays.

    Raises:
        UnsafeMotion: there are none or too many, a leg is outside the controller's range (`check_joint_motion`,
            `check_linear_motion`), or a blend radius is negative or no number, or the last one is above 0.
    """
    if not 1 <= len(waypoints) <= _MAX_LEGS:
        raise UnsafeMotion(f"a path of {len(waypoints)} legs: it must have 1 to {_MAX_LEGS}")
    checked: list[Waypoint] = []
    for i, waypoint in enumerate(waypoints):
        allowed = _MAX_BLEND_M if i < len(waypoints) - 1 else 0.0
        if not 0 <= waypoint.blend_m <= allowed:
            raise UnsafeMotion(
                f"leg {i + 1} of a path: blend radius {waypoint.blend_m} m is outside 0 to {allowed:g} m"
            )
        if isinstance(waypoint, JointWaypoint):
            q = check_joint_motion(waypoint.q, waypoint.speed_rad_s, waypoint.acceleration_rad_s2)
            checked.append(replace(waypoint, q=q))
        elif isinstance(waypoint, LinearWaypoint):
            T = check_linear_motion(waypoint.T_base_tcp, waypoint.speed_m_s, waypoint.acceleration_m_s2)
            checked.append(replace(waypoint, T_base_tcp=T))
        else:
            raise TypeError(f"{type(waypoint).__name__} is no waypoint")
    return tuple(checked)


def _check_range(what: str, value: float, high: float, unit: str) -> None:
    if not math.isfinite(value) or not 0 < value <= high:
        raise UnsafeMotion(f"{what} {value} {unit} is outside the controller's range of above 0 to {high:g} {unit}")
