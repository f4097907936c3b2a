"""How the arm of the UR controller moves: one new joint target per control period.

A motion is a generator that commands one target and yields, once per period, until it has ended. What URScript knows of
moves, stops, speed and servo commands is here; what a program does between them is in ur_program and ur_control_loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from ur_analytic_ik import ur5e as analytic_ik

from robotcell.geometry import ur5e
from robotcell.geometry.transforms import Array, invert_transform, rotvec_to_matrix
from sim_twin.devices.arm import ROTATION_LEVER_M, STOP_DECELERATION_RAD_S2
from sim_twin.devices.trajectory import Trapezoid
from sim_twin.wire.ur.pose import ZERO_POSE, Pose, matrix_to_pose, pose_to_matrix, rotation_vector

PERIOD_S = 0.002

# Two targets of neighbouring periods may differ by this much: half more than at the fastest joint speed.
_MAX_STEP_RAD = 1.5 * ur5e.MAX_JOINT_SPEED * PERIOD_S
_ARRIVED_RAD = 1e-9
_LARGEST = 1e6
_SLOWEST = 1e-5
# Inverse kinematics is exact to this many digits; an arm that follows them stands still.
_STEADY_RAD_S = 1e-5

Motion: TypeAlias = Generator[None, None, None]


class ScriptError(Exception):
    """A script does what the controller refuses; it dies with this message."""


def checked(number: float) -> float:
    """A number that a script may use.

    Raises:
        ScriptError: it is none, or so large that no robot has a use for it.
    """
    if not abs(number) <= _LARGEST:
        raise ScriptError(f"{number} is no number that the controller can use")
    return number


class Arm:
    """The joint targets of the arm, and what was measured.

    Args:
        q: (6,) joint angles [rad] at the start.

    Attributes:
        q: (6,) the joint target [rad] of this period.
        qd: (6,) its speed [rad/s].
        qdd: (6,) its acceleration [rad/s^2].
        measured_q, measured_qd: (6,) of the joints [rad, rad/s].
        wrench: (6,) force [N] and torque [N m] on the tool, base axes, about the flange.
        tcp_wrench: (6,) the same about the tcp, less what the sensor was zeroed at.
        rate: how much motion time passes per period, 0 to 1: slider and pause.
        tcp: pose of the tool centre point in the flange.
        freedrive: whether the targets follow the joints.
        force_mode: what the tool gives way to, None when it is stiff.
        reachable: whether inverse kinematics finds anything; a fault can take it away.
        arrives: whether a move ever ends; a fault can take it away.
        waypoint: (6,) where the move under way, or the last one, leads.
    """

    def __init__(self, q: Array) -> None:
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros(6)
        self.qdd = np.zeros(6)
        self.measured_q = self.q.copy()
        self.measured_qd = np.zeros(6)
        self.wrench = np.zeros(6)
        self.tcp_wrench = np.zeros(6)
        self.rate = 1.0
        self.freedrive = False
        self.force_mode: ForceMode | None = None
        self.reachable = True
        self.arrives = True
        self.waypoint = self.q
        self.tcp: Pose = ZERO_POSE
        self.set_tcp(ZERO_POSE)
        self._zero_wrench = np.zeros(6)
        # The speed with which a motion was left; braking starts from it.
        self._momentum = np.zeros(6)
        self._commanded = False
        self._before = self.q.copy()

    @property
    def steady(self) -> bool:
        """Whether the target stands still."""
        return bool(max(np.abs(self._momentum).max(), np.abs(self.qd).max()) < _STEADY_RAD_S)

    @property
    def momentum(self) -> Array:
        """(6,) joint speed [rad/s] of the motion under way; zero once it has ended."""
        return self._momentum

    def set_tcp(self, tcp: Sequence[float]) -> None:
        """Take another tool centre point."""
        self.tcp = (tcp[0], tcp[1], tcp[2], tcp[3], tcp[4], tcp[5])
        self.T_flange_tcp = pose_to_matrix(tcp)
        self._T_tcp_flange = invert_transform(self.T_flange_tcp)

    def flange(self, q: Array) -> Array:
        """T_base_flange of joint angles (6,); a tenth of the time of `ur5e.forward`."""
        return np.asarray(analytic_ik.forward_kinematics(*q))

    def forward(self, q: Array) -> Array:
        """T_base_tcp of joint angles (6,)."""
        return np.asarray(self.flange(q) @ self.T_flange_tcp)

    def inverse(self, T_base_tcp: Array, q_near: Array) -> Array:
        """The joint angles (6,) nearest to `q_near` that reach a pose of the tcp.

        Raises:
            ScriptError: there are none.
        """
        q = ur5e.inverse(T_base_tcp @ self._T_tcp_flange, q_near) if self.reachable else None
        if q is None:
            x, y, z = T_base_tcp[:3, 3]
            raise ScriptError(f"get_inverse_kin: cannot find a solution for x {x:.4f}, y {y:.4f}, z {z:.4f} m")
        return q

    def twist(self, q: Array, qd: Array) -> Array:
        """(6,) speed of the tcp [m/s, rad/s] in base axes, of joint angles and speeds."""
        if not qd.any():
            return np.zeros(6)
        h = 1e-6
        T, T_next = self.forward(q), self.forward(q + h * qd)
        w = rotation_vector(T_next[:3, :3] @ T[:3, :3].T)
        return np.concatenate([T_next[:3, 3] - T[:3, 3], w]) / h

    def measure(self, q: Array, qd: Array, wrench: Array) -> None:
        """Take in what was measured of the joints, each (6,), and of the wrench about the flange (6,)."""
        self.measured_q, self.measured_qd, self.wrench = q, qd, wrench
        self.tcp_wrench = self._wrench_at_tcp() - self._zero_wrench

    def zero_wrench(self) -> None:
        """Count from here what the sensor reads now."""
        self._zero_wrench = self._wrench_at_tcp()

    def command(self, q: Array) -> None:
        """Set the target of this period.

        Raises:
            ScriptError: another motion has set it already, or a joint would have to turn faster than it can.
        """
        if self._commanded:
            raise ScriptError("another thread is already controlling the robot")
        step = np.abs(q - self.q)
        # A step that is no number is refused too.
        if not step.max() <= _MAX_STEP_RAD:
            joint = int(step.argmax())
            raise ScriptError(
                f"joint {joint + 1} would have to turn at {step[joint] / PERIOD_S:.1f} rad/s: the path is too close to "
                "a singularity, or the arm is not where the motion was left"
            )
        self._commanded = True
        self.q = q
        self._momentum = (q - self._before) / PERIOD_S

    def rest(self) -> None:
        """Say that the motion has ended where it should."""
        self._momentum = np.zeros(6)

    def hold(self) -> None:
        """Take the joints, as they are, for the target."""
        self.q = self.measured_q.copy()
        self._before = self.q.copy()
        self._momentum = np.zeros(6)

    def finish_period(self) -> None:
        """Complete the target of this period: give way where that is asked for, brake where no motion is under way."""
        if self.freedrive and not self._commanded:
            self.hold()
        elif not self._commanded:
            self.q, self._momentum = _braked(self.q, self._momentum, STOP_DECELERATION_RAD_S2, PERIOD_S)
        if self.force_mode is not None:
            self._give_way(self.force_mode)
        qd = (self.q - self._before) / PERIOD_S
        self.qdd = (qd - self.qd) / PERIOD_S
        self.qd = qd
        self._before = self.q.copy()
        self._commanded = False

    def _wrench_at_tcp(self) -> Array:
        if not self.wrench.any():
            return self.wrench
        arm = self.flange(self.measured_q)[:3, :3] @ self.T_flange_tcp[:3, 3]
        fx, fy, fz, tx, ty, tz = self.wrench.tolist()
        x, y, z = arm.tolist()
        return np.array([fx, fy, fz, tx - (y * fz - z * fy), ty - (z * fx - x * fz), tz - (x * fy - y * fx)])

    def _give_way(self, mode: ForceMode) -> None:
        T = self.forward(self.q)
        twist = mode.twist(self.tcp_wrench)
        if not twist.any():
            return
        try:
            q = self.inverse(_moved(T, twist * PERIOD_S), self.q)
        except ScriptError:
            return
        if np.abs(q - self.q).max() <= _MAX_STEP_RAD:
            self.q = q


@dataclass
class ForceMode:
    """An admittance: along each compliant axis of a frame the tool moves at a speed in proportion to the missing force.

    The real controller also weighs damping and the speed of the contact; this is the simplest law that reaches the
    commanded force against a surface and keeps the commanded limit in free space.

    Attributes:
        R_base_task: (3, 3) axes of the task frame.
        selection: (6,) 1 along the compliant axes.
        wrench: (6,) that the robot shall exert, task axes [N, N m].
        limits: (6,) greatest speed along the compliant axes [m/s, rad/s]; the others are position controlled.
        gain: force_mode_set_gain_scaling.
    """

    R_base_task: Array
    selection: Array
    wrench: Array
    limits: Array
    gain: float

    # Speed per force and per torque at gain 1: 50 N missing move the tool at 0.05 m/s. Assumed.
    _MOBILITY = np.array([1e-3, 1e-3, 1e-3, 2e-2, 2e-2, 2e-2])

    def twist(self, measured: Array) -> Array:
        """(6,) speed [m/s, rad/s] in base axes, of the wrench (6,) that the surroundings exert, base axes."""
        R = self.R_base_task
        task = np.concatenate([R.T @ measured[:3], R.T @ measured[3:]])
        speed = self.gain * self._MOBILITY * (self.wrench + task)
        speed = np.clip(speed, -np.abs(self.limits), np.abs(self.limits)) * (self.selection != 0)
        return np.concatenate([R @ speed[:3], R @ speed[3:]])


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
    """

    target: tuple[float, ...]
    is_pose: bool
    straight: bool
    speed: float
    acceleration: float
    blend_m: float = 0.0
    number: int = 0


def follow(arm: Arm, moves: Sequence[Move], begin: Callable[[int], None] = lambda _: None) -> Motion:
    """Move along a path of moves.

    Within its blend radius a move overlaps with the next one of its kind: their displacements add up, so the tool stays
    inside the corner and both ends are met. Moves of different kinds meet at a standstill.

    Args:
        arm: that moves.
        moves: of the path, in order.
        begin: called with each move's number when it begins.

    Raises:
        ScriptError: a target, or a pose on the way, cannot be reached.
    """
    for move in moves:
        if not (move.speed >= _SLOWEST and move.acceleration >= _SLOWEST):
            raise ScriptError(f"move: speed and acceleration must be at least {_SLOWEST:g}")
    yield from stop_joints(arm, STOP_DECELERATION_RAD_S2)
    waiting = list(moves)
    active: list[_JointLeg | _LineLeg] = []
    q_end = arm.q
    while waiting or active:
        if waiting and (not active or (len(active) == 1 and active[0].may_blend(arm, waiting[0]))):
            move = waiting.pop(0)
            # The blend ends by half way, so that a move has come to its own line before the next one begins.
            leg = _leg(arm, move, q_end)
            q_end = arm.waypoint = leg.q_goal
            begin(move.number)
            if leg.duration > 0:
                active.append(leg)
        if not active:
            continue
        for leg in active:
            leg.t = min(leg.t + arm.rate * PERIOD_S, leg.duration)
        arm.command(active[0].q_now(arm, active[1:]))
        if active[0].t >= active[0].duration:
            active.pop(0)
        if not active and not waiting:
            while not arm.arrives:
                arm.rest()
                yield
                arm.command(arm.q)
            arm.rest()
        yield


def stop_joints(arm: Arm, deceleration: float) -> Motion:
    """Brake the joints, the leading one at `deceleration` [rad/s^2]. stopj."""
    if not deceleration > 0:
        raise ScriptError("stopj: the deceleration must be positive")
    momentum = arm.momentum
    q = arm.q
    while momentum.any():
        q, momentum = _braked(q, momentum, deceleration, PERIOD_S)
        arm.command(q)
        if not momentum.any():
            arm.rest()
        yield


def stop_line(arm: Arm, deceleration: float) -> Motion:
    """Brake the tool on its line at `deceleration` [m/s^2]; the joints, where the tool turns on the spot. stopl."""
    if not deceleration > 0:
        raise ScriptError("stopl: the deceleration must be positive")
    twist = arm.twist(arm.q, arm.momentum)
    speed = max(float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:])) * ROTATION_LEVER_M)
    if speed == 0:
        yield from stop_joints(arm, STOP_DECELERATION_RAD_S2)
        return
    T = arm.forward(arm.q)
    factor = 1.0
    while factor > 0:
        after = max(0.0, factor - deceleration * PERIOD_S / speed)
        T = _moved(T, twist * (0.5 * (factor + after) * PERIOD_S))
        factor = after
        try:
            arm.command(arm.inverse(T, arm.q))
        except ScriptError:
            # Beside a singularity the line cannot be kept; the arm still stops.
            yield from stop_joints(arm, STOP_DECELERATION_RAD_S2)
            return
        if factor == 0:
            arm.rest()
        yield


def speed_joints(arm: Arm, speed: Array, acceleration: float, time: float) -> Motion:
    """Accelerate the joints to `speed` (6,) [rad/s] and keep it, for `time` [s] or until it is reached. speedj."""
    if not acceleration > 0:
        raise ScriptError("speedj: the acceleration must be positive")
    elapsed = 0.0
    while True:
        now = arm.momentum / arm.rate if arm.rate > 0 else np.zeros(6)
        missing = speed - now
        share = min(1.0, acceleration * PERIOD_S / max(float(np.abs(missing).max()), 1e-12))
        arm.command(arm.q + (now + share * missing) * (arm.rate * PERIOD_S))
        elapsed += PERIOD_S
        yield
        if elapsed >= time and (time > 0 or share == 1.0):
            return


def speed_line(arm: Arm, speed: Array, acceleration: float, time: float) -> Motion:
    """Accelerate the tool to `speed` (6,) [m/s, rad/s] in base axes and keep it, as `speed_joints`. speedl."""
    if not acceleration > 0:
        raise ScriptError("speedl: the acceleration must be positive")
    elapsed = 0.0
    while True:
        now = arm.twist(arm.q, arm.momentum) / arm.rate if arm.rate > 0 else np.zeros(6)
        missing = speed - now
        lead = max(float(np.linalg.norm(missing[:3])), float(np.linalg.norm(missing[3:])), 1e-12)
        share = min(1.0, acceleration * PERIOD_S / lead)
        step = (now + share * missing) * (arm.rate * PERIOD_S)
        arm.command(arm.inverse(_moved(arm.forward(arm.q), step), arm.q) if step.any() else arm.q)
        elapsed += PERIOD_S
        yield
        if elapsed >= time and (time > 0 or share == 1.0):
            return


def servo_joints(arm: Arm, q: Array, time: float, lookahead: float, gain: float) -> Motion:
    """Chase joint angles (6,) for `time` [s]. servoj.

    A critically damped second-order lag whose time constant is half the look-ahead at the usual gain of 300; speed and
    acceleration stay within those of the joints. The real controller's filter is not public.
    """
    if not lookahead > 0 or not gain > 0:
        raise ScriptError("servoj: look-ahead time and gain must be positive")
    omega = 2 / max(lookahead, 0.03) * math.sqrt(min(gain, 2000.0) / 300)
    elapsed = 0.0
    while True:
        qd = arm.momentum / arm.rate if arm.rate > 0 else np.zeros(6)
        qdd = omega**2 * (q - arm.q) - 2 * omega * qd
        qdd = np.clip(qdd, -ur5e.MAX_JOINT_ACCELERATION, ur5e.MAX_JOINT_ACCELERATION)
        qd = np.clip(qd + qdd * PERIOD_S, -ur5e.MAX_JOINT_SPEED, ur5e.MAX_JOINT_SPEED)
        if max(np.abs(q - arm.q).max(), np.abs(qd).max() * PERIOD_S) < _ARRIVED_RAD:
            qd = np.zeros(6)
        arm.command(arm.q + qd * (arm.rate * PERIOD_S))
        elapsed += PERIOD_S
        yield
        if elapsed >= time:
            return


def servo_circular(arm: Arm, pose: Sequence[float], speed: float, acceleration: float) -> Motion:
    """Move the tool to a pose at a steady speed, from whatever it does now. servoc, without its circular blend."""
    if not (speed > 0 and acceleration > 0):
        raise ScriptError("servoc: speed and acceleration must be positive")
    T_goal = pose_to_matrix(pose)
    while True:
        T = arm.forward(arm.q)
        way = np.concatenate([T_goal[:3, 3] - T[:3, 3], rotation_vector(T_goal[:3, :3] @ T[:3, :3].T)])
        distance = max(float(np.linalg.norm(way[:3])), float(np.linalg.norm(way[3:])) * ROTATION_LEVER_M)
        approach = min(speed, math.sqrt(2 * acceleration * distance))
        if distance <= approach * PERIOD_S:
            arm.command(arm.inverse(T_goal, arm.q))
            arm.rest()
            yield
            return
        yield from speed_line(arm, way / distance * approach, acceleration, PERIOD_S)


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
        self.turn = np.array(rotation_vector(T_goal[:3, :3] @ self._T_start[:3, :3].T))
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
            T = _moved(self._T_start, self.share() * np.concatenate([self.way, self.turn]))
        for leg in others:
            assert isinstance(leg, _LineLeg)
            T = _moved(T, leg.share() * np.concatenate([leg.way, leg.turn]))
        return arm.inverse(T, arm.q)

    def may_blend(self, arm: Arm, following: Move) -> bool:
        """Whether the next move may begin."""
        if self._blend_m <= 0 or not following.straight or self.share() < 0.5:
            return False
        return (1 - self.share()) * float(np.linalg.norm(self.way)) <= self._blend_m


def _leg(arm: Arm, move: Move, q_start: Array) -> _JointLeg | _LineLeg:
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


def _braked(q: Array, momentum: Array, deceleration: float, period: float) -> tuple[Array, Array]:
    """Target and speed after one period of braking along a straight line in joint space."""
    speed = float(np.abs(momentum).max())
    if speed == 0:
        return q, momentum
    after = max(0.0, speed - deceleration * period)
    return q + momentum * (0.5 * (speed + after) / speed * period), momentum * (after / speed)


def _moved(T: Array, displacement: Array) -> Array:
    """T after a displacement (6,) [m, rad] in base axes: the origin moves, the axes turn about it."""
    moved = T.copy()
    moved[:3, 3] += displacement[:3]
    moved[:3, :3] = rotvec_to_matrix(displacement[3:]) @ T[:3, :3]
    return np.asarray(moved)


def tcp_pose(arm: Arm, q: Array) -> Pose:
    """The pose of the tcp at joint angles (6,)."""
    return matrix_to_pose(arm.forward(q))
