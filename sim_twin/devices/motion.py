"""Motions as the twins drive them: legs to targets, corners rounded, in time. The same for both twins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from robotcell.geometry import ur5e
from robotcell.geometry.rounded_path import round_corners
from robotcell.geometry.transforms import interpolate_transforms, invert_transform, rotation_angle
from robotcell.interfaces import JointWaypoint
from sim_twin.devices.arm_limits import MAX_TARGET_SPEED_RAD_S
from sim_twin.devices.trajectory import LegLimits, time_path

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from robotcell.interfaces import Array, Waypoint

# Distance between the samples of a leg, from which cubic curves are laid. A line is met to a hundredth of a millimetre.
_JOINT_STEP_RAD = 0.02
_LINEAR_STEP_M = 0.005
_ROTATION_STEP_RAD = 0.02
_FEWEST_SAMPLES = 9
_CORNER_SAMPLES = 25
# Inverse kinematics that are solved in about a millisecond.
_SOLUTIONS_A_STEP = 12
# Neighbouring samples of a line between which a joint turns further lie on two sides of a singularity.
_LEAP_RAD = 0.35


@dataclass(frozen=True)
class Motion:
    """A motion in time.

    Attributes:
        q: (N, 6) joint angles [rad] after 1, 2, ... N periods.
        leg: (N,) the leg that each belongs to.
        breaks_off: the arm cannot follow the motion any further than this.
    """

    q: Array
    leg: npt.NDArray[np.int64]
    breaks_off: bool


def plan_motion(q_start: Array, waypoints: Sequence[Waypoint], T_flange_tcp: Array, period: float) -> Motion:
    """The motion from rest at `q_start` (6,) through waypoints. At one without a blend radius it comes to rest.

    Args:
        q_start: joint angles [rad].
        waypoints: at the ends of the legs.
        T_flange_tcp: (4, 4) the tool.
        period: time between samples [s].
    """
    steps = plan_motion_stepwise(q_start, waypoints, T_flange_tcp, period)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast("Motion", end.value)


def plan_motion_stepwise(
    q_start: Array, waypoints: Sequence[Waypoint], T_flange_tcp: Array, period: float
) -> Generator[None, None, Motion]:
    """As `plan_motion`, in steps of about a millisecond, for a loop that must not be held up; one step at least."""
    parts: list[Array] = []
    owners: list[npt.NDArray[np.int64]] = []
    q, first = np.asarray(q_start, np.float64), 0
    while first < len(waypoints):
        last = first
        while waypoints[last].blend_m > 0 and last < len(waypoints) - 1:
            last += 1
        legs, complete = yield from _legs(q, waypoints[first : last + 1], T_flange_tcp)
        run = waypoints[first : first + len(legs)]
        path = round_corners(legs, [waypoint.blend_m for waypoint in run], T_flange_tcp, _CORNER_SAMPLES)
        yield
        trajectory = time_path(path, [_limits(waypoint) for waypoint in run], T_flange_tcp, period, stops=complete)
        steps = np.abs(np.diff(np.vstack([q, trajectory.q]), axis=0)).max(axis=1, initial=0.0)
        leaps = np.flatnonzero(steps > MAX_TARGET_SPEED_RAD_S * period)
        end = int(leaps[0]) if leaps.size else len(trajectory.q)
        parts.append(trajectory.q[:end])
        owners.append(trajectory.leg[:end] + first)
        if leaps.size or not complete:
            return Motion(np.vstack(parts), np.concatenate(owners), breaks_off=True)
        q, first = legs[-1][-1], last + 1
    return Motion(np.vstack(parts), np.concatenate(owners), breaks_off=False)


def _limits(waypoint: Waypoint) -> LegLimits:
    if isinstance(waypoint, JointWaypoint):
        return LegLimits(False, waypoint.speed_rad_s, waypoint.acceleration_rad_s2)
    return LegLimits(True, waypoint.speed_m_s, waypoint.acceleration_m_s2)


def _legs(
    q: Array, waypoints: Sequence[Waypoint], T_flange_tcp: Array
) -> Generator[None, None, tuple[list[Array], bool]]:
    """Joint angles (N, 6) along each leg from q (6,), as far as the arm can follow; and whether that is to the end."""
    legs: list[Array] = []
    for waypoint in waypoints:
        if isinstance(waypoint, JointWaypoint):
            leg, complete = _joint_leg(q, waypoint.q), True
        else:
            leg, complete = yield from _line(q, waypoint.T_base_tcp, T_flange_tcp)
        legs.append(leg)
        if not complete:
            return legs, False
        q = leg[-1]
    return legs, True


def _joint_leg(q: Array, goal: Array) -> Array:
    count = max(_FEWEST_SAMPLES, int(np.ceil(float(np.abs(goal - q).max()) / _JOINT_STEP_RAD)) + 1)
    return np.asarray(q + np.linspace(0.0, 1.0, count)[:, None] * (goal - q))


def _line(q: Array, T_goal: Array, T_flange_tcp: Array) -> Generator[None, None, tuple[Array, bool]]:
    T_start = ur5e.forward(q) @ T_flange_tcp
    length = float(np.linalg.norm(T_goal[:3, 3] - T_start[:3, 3]))
    steps = max(length / _LINEAR_STEP_M, rotation_angle(T_start[:3, :3], T_goal[:3, :3]) / _ROTATION_STEP_RAD)
    count = max(_FEWEST_SAMPLES, int(np.ceil(steps)) + 1)
    T_tcp_flange = invert_transform(T_flange_tcp)
    leg = [q]
    for T in interpolate_transforms(T_start, T_goal, np.linspace(0.0, 1.0, count)[1:]) @ T_tcp_flange:
        solution = ur5e.inverse(T, leg[-1])
        if solution is None or float(np.abs(solution - leg[-1]).max()) > _LEAP_RAD:
            # Twice where there is no more than the start: a leg has two ends.
            return np.array(leg if len(leg) > 1 else [q, q]), False
        leg.append(solution)
        if len(leg) % _SOLUTIONS_A_STEP == 0:
            yield
    return np.array(leg), True
