"""Moves to a target, one after another or blended: movej, movel and paths of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry import ur5e
from robotcell.geometry.transforms import matrix_to_rotvec
from sim_twin.devices.arm_limits import ROTATION_LEVER_M, STOP_DECELERATION_RAD_S2
from sim_twin.devices.trajectory import Trapezoid
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.pose import displaced, pose_to_matrix
from sim_twin.wire.ur.program import ScriptError, Thread
from sim_twin.wire.ur.stops import stop_joints

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from robotcell.interfaces import Array
    from sim_twin.wire.ur.arm import Arm

# A move that is slower than this [m/s, rad/s and per second] would never end.
SLOWEST = 1e-5


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

    Within its blend radius a move overlaps with the next one of its kind: their displacements add up, so the tool stays
    inside the corner and both ends are met. Moves of different kinds meet at a standstill.

    Args:
        arm: that moves.
        moves: of the path, in order. A move is taken up when the one before it begins.
        begin: called with each move's number when it begins.

    Raises:
        ScriptError: a target, or a pose on the way, cannot be reached.
    """
    yield from stop_joints(arm, STOP_DECELERATION_RAD_S2)
    waiting = iter(moves)
    upcoming = next(waiting, None)
    active: list[_JointLeg | _LineLeg] = []
    q_end = arm.q
    while upcoming is not None or active:
        if upcoming is not None and (not active or (len(active) == 1 and active[0].may_blend(arm, upcoming))):
            move, upcoming = upcoming, next(waiting, None)
            # The blend ends by half way, so that a move has come to its own line before the next one begins.
            leg = _leg(arm, move, q_end)
            q_end = arm.waypoint = leg.q_goal
            begin(move.number)
            if leg.duration > 0:
                active.append(leg)
        if not active:
            # A move that leads nowhere takes a period, so that a thousand of them cannot hold one up.
            arm.rest()
            yield
            continue
        for leg in active:
            leg.t = min(leg.t + arm.rate * PERIOD_S, leg.duration)
        arm.command(active[0].q_now(arm, active[1:]))
        if active[0].t >= active[0].duration:
            active.pop(0)
        if not active and upcoming is None:
            while not arm.arrives:
                arm.rest()
                yield
                arm.command(arm.q)
            arm.rest()
        yield


class _JointLeg:
    """A move of the joints from `q_start`."""

    straight = False

    def __init__(self, q_start: Array, q_goal: Array, move: Move) -> None:
        self.q_goal = q_goal
        self.t = 0.0
        self.way = q_goal - q_start
        self._start = q_start
        self._blend_m = move.blend_m
        self._distance = float(np.abs(self.way).max())
        self._profile = Trapezoid(self._distance, move.speed, move.acceleration) if self._distance > 0 else None
        self.duration = self._profile.duration if self._profile else 0.0

    def share(self) -> float:
        """How much of the way is done."""
        return _share(self._profile, self.t, self.duration)

    def q_now(self, arm: Arm, others: Sequence[_JointLeg | _LineLeg]) -> Array:
        """The target, with the displacement of a leg that has begun meanwhile."""
        q = self.q_goal if self.t >= self.duration else self._start + self.share() * self.way
        for leg in others:
            assert isinstance(leg, _JointLeg)
            q = q + leg.share() * leg.way
        return q

    def may_blend(self, arm: Arm, following: Move) -> bool:
        """Whether the next move may begin."""
        if self._blend_m <= 0 or following.straight or self.share() < 0.5:
            return False
        rest = arm.forward(self._start + self.share() * self.way)[:3, 3] - arm.forward(self.q_goal)[:3, 3]
        return float(np.linalg.norm(rest)) <= self._blend_m


class _LineLeg:
    """A move of the tool on a line from where `q_start` puts it."""

    straight = True

    def __init__(self, arm: Arm, q_start: Array, T_goal: Array, q_goal: Array, move: Move) -> None:
        self.q_goal = q_goal
        self.t = 0.0
        self._T_start, self._T_goal = arm.forward(q_start), T_goal
        self.way = T_goal[:3, 3] - self._T_start[:3, 3]
        self.turn = matrix_to_rotvec(T_goal[:3, :3] @ self._T_start[:3, :3].T)
        self._blend_m = move.blend_m
        length, turn = float(np.linalg.norm(self.way)), float(np.linalg.norm(self.turn))
        distance = max(length, turn * ROTATION_LEVER_M)
        if distance < 1e-9:
            distance = 0.0
        self._profile = Trapezoid(distance, move.speed, move.acceleration) if distance > 0 else None
        self.duration = self._profile.duration if self._profile else 0.0

    def share(self) -> float:
        """How much of the way is done."""
        return _share(self._profile, self.t, self.duration)

    def q_now(self, arm: Arm, others: Sequence[_JointLeg | _LineLeg]) -> Array:
        """The target, with the displacement of a leg that has begun meanwhile."""
        if self.t >= self.duration:
            T = self._T_goal
        else:
            T = displaced(self._T_start, self.share() * np.concatenate([self.way, self.turn]))
        for leg in others:
            assert isinstance(leg, _LineLeg)
            T = displaced(T, leg.share() * np.concatenate([leg.way, leg.turn]))
        return arm.inverse(T, arm.q)

    def may_blend(self, arm: Arm, following: Move) -> bool:
        """Whether the next move may begin."""
        if self._blend_m <= 0 or not following.straight or self.share() < 0.5:
            return False
        return (1 - self.share()) * float(np.linalg.norm(self.way)) <= self._blend_m


def _leg(arm: Arm, move: Move, q_start: Array) -> _JointLeg | _LineLeg:
    try:
        return _leg_of(arm, move, q_start)
    except ScriptError as error:
        raise ScriptError(str(error), move.line) from None


def _leg_of(arm: Arm, move: Move, q_start: Array) -> _JointLeg | _LineLeg:
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
    if move.straight:
        return _LineLeg(arm, q_start, T_goal, q_goal, move)
    return _JointLeg(q_start, q_goal, move)


def _share(profile: Trapezoid | None, t: float, duration: float) -> float:
    if profile is None or t >= duration:
        return 1.0
    return float(profile.position(t)) / profile.distance
