"""Moves to a target, one after another or blended: movej, movel and paths of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry import ur5e
from robotcell.interfaces import JointWaypoint, LinearWaypoint
from sim_twin.devices.arm_limits import STOP_DECELERATION_RAD_S2
from sim_twin.devices.motion import plan_motion_stepwise
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.pose import pose_to_matrix
from sim_twin.wire.ur.program import ScriptError, Thread
from sim_twin.wire.ur.stops import stop_joints

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from robotcell.interfaces import Array, Waypoint
    from sim_twin.wire.ur.arm import Arm

# A move that is slower than this [m/s, rad/s and per second] would never end.
SLOWEST = 1e-5
# Moves that are planned as one. The real controller looks ahead too; how far is not public.
_MOST_BLENDED = 50


@dataclass(frozen=True)
class Move:
    """One move of a path.

    Attributes:
        target: joint angles (6,) [rad], or the pose of the tcp.
        is_pose: which of the two.
        straight: the tool moves on a line; else the joints move together.
        speed: of the tool [m/s] or of the leading joint [rad/s].
        acceleration: of the same.
        blend_m: radius around the target where the next move may begin.
        number: of the waypoint, for the progress.
        line: of its program, for messages; 0 where it is not known.
    """

    target: tuple[float, ...]
    is_pose: bool
    straight: bool
    speed: float
    acceleration: float
    blend_m: float = 0.0
    number: int = 0
    line: int = field(default=0, compare=False)


def follow(arm: Arm, moves: Iterable[Move], begin: Callable[[int], None] = lambda _: None) -> Thread:
    """Move along a path of moves.

    Within its blend radius a move gives way to the next one, of whatever kind, on the curve of
    `robotcell.geometry.rounded_path`; at one without a radius the arm comes to a standstill.

    Args:
        arm: that moves.
        moves: of the path, in order. Those that blend are taken up together, the next ones when they have ended.
        begin: called with each move's number when it begins.

    Raises:
        ScriptError: a target, or a pose on the way, cannot be reached.
    """
    yield from stop_joints(arm, STOP_DECELERATION_RAD_S2)
    waiting = iter(moves)
    for first in waiting:
        blended = [first]
        while blended[-1].blend_m > 0 and len(blended) < _MOST_BLENDED:
            following = next(waiting, None)
            if following is None:
                break
            blended.append(following)
        yield from _drive(arm, blended, begin)


def _drive(arm: Arm, moves: Sequence[Move], begin: Callable[[int], None]) -> Thread:
    """Move along moves that blend, from rest to rest."""
    q, goals, waypoints = arm.q, [], []
    for move in moves:
        waypoint, q = _waypoint(arm, move, q)
        goals.append(q)
        waypoints.append(waypoint)
    waypoints[-1] = replace(waypoints[-1], blend_m=0.0)
    motion = yield from plan_motion_stepwise(arm.q, waypoints, arm.T_flange_tcp, PERIOD_S)
    samples, begun, t, end = np.vstack([arm.q, motion.q]), 0, 0.0, float(len(motion.q))
    while True:
        t = min(t + arm.rate, end)
        leg = int(motion.leg[math.ceil(t) - 1]) if t > 0 else 0
        while begun <= (len(moves) - 1 if t >= end and not motion.breaks_off else leg):
            arm.waypoint = goals[begun]
            begin(moves[begun].number)
            begun += 1
        if moves[leg].straight and not arm.reachable:
            # Says so.
            arm.inverse(arm.forward(arm.q), arm.q)
        k = min(int(t), max(len(samples) - 2, 0))
        q = samples[k] if t == k else samples[k] + (t - k) * (samples[k + 1] - samples[k])
        if t < end or not motion.breaks_off:
            arm.command(q)
        if t >= end:
            break
        yield
    if motion.breaks_off:
        x, y, z = arm.forward(goals[begun - 1])[:3, 3]
        raise ScriptError(
            f"get_inverse_kin: cannot find a solution on the line to x {x:.4f}, y {y:.4f}, z {z:.4f} m: it leaves the "
            "arm's reach, or passes too close to a singularity",
            moves[begun - 1].line,
        )
    while not arm.arrives:
        arm.rest()
        yield
        arm.command(arm.q)
    arm.rest()
    yield


def _waypoint(arm: Arm, move: Move, q_start: Array) -> tuple[Waypoint, Array]:
    """A move as the planner takes it, and the joint angles (6,) at its end."""
    try:
        return _waypoint_of(arm, move, q_start)
    except ScriptError as error:
        raise ScriptError(str(error), move.line) from None


def _waypoint_of(arm: Arm, move: Move, q_start: Array) -> tuple[Waypoint, Array]:
    if not (move.speed >= SLOWEST and move.acceleration >= SLOWEST):
        raise ScriptError(f"move: speed and acceleration must be at least {SLOWEST:g}")
    if move.is_pose:
        T_goal = pose_to_matrix(move.target)
        q_goal = arm.inverse(T_goal, q_start)
    else:
        q_goal = np.array(move.target)
        if not (np.abs(q_goal) <= ur5e.JOINT_LIMIT).all():
            raise ScriptError(f"move: {np.round(q_goal, 3).tolist()} is outside the joint limits")
        T_goal = arm.forward(q_goal)
    blend_m = max(move.blend_m, 0.0)
    if move.straight:
        return LinearWaypoint(T_goal, move.speed, move.acceleration, blend_m), q_goal
    return JointWaypoint(q_goal, move.speed, move.acceleration, blend_m), q_goal
