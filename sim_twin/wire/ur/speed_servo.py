"""Motions that a program steers from period to period: speedj, speedl, servoj and servoc."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry import ur5e
from robotcell.geometry.transforms import matrix_to_rotvec
from sim_twin.devices.arm_limits import ROTATION_LEVER_M
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.pose import displaced, pose_to_matrix
from sim_twin.wire.ur.program import ScriptError, Thread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.interfaces import Array
    from sim_twin.wire.ur.arm import Arm

_ARRIVED_RAD = 1e-9


def speed_joints(arm: Arm, speed: Array, acceleration: float, time: float) -> Thread:
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


def speed_line(arm: Arm, speed: Array, acceleration: float, time: float) -> Thread:
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
        arm.command(arm.inverse(displaced(arm.forward(arm.q), step), arm.q) if step.any() else arm.q)
        elapsed += PERIOD_S
        yield
        if elapsed >= time and (time > 0 or share == 1.0):
            return


def servo_joints(arm: Arm, q: Array, time: float, lookahead: float, gain: float) -> Thread:
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


def servo_circular(arm: Arm, pose: Sequence[float], speed: float, acceleration: float) -> Thread:
    """Move the tool to a pose at a steady speed, from whatever it does now. servoc, without its circular blend."""
    if not (speed > 0 and acceleration > 0):
        raise ScriptError("servoc: speed and acceleration must be positive")
    T_goal = pose_to_matrix(pose)
    while True:
        T = arm.forward(arm.q)
        way = np.concatenate([T_goal[:3, 3] - T[:3, 3], matrix_to_rotvec(T_goal[:3, :3] @ T[:3, :3].T)])
        distance = max(float(np.linalg.norm(way[:3])), float(np.linalg.norm(way[3:])) * ROTATION_LEVER_M)
        approach = min(speed, math.sqrt(2 * acceleration * distance))
        if distance <= approach * PERIOD_S:
            arm.command(arm.inverse(T_goal, arm.q))
            arm.rest()
            yield
            return
        yield from speed_line(arm, way / distance * approach, acceleration, PERIOD_S)
