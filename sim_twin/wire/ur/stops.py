"""Stops: stopj and stopl."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_twin.devices.arm_limits import ROTATION_LEVER_M, STOP_DECELERATION_RAD_S2
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.arm import braked
from sim_twin.wire.ur.pose import displaced
from sim_twin.wire.ur.program import ScriptError, Thread

if TYPE_CHECKING:
    from sim_twin.wire.ur.arm import Arm


def stop_joints(arm: Arm, deceleration: float) -> Thread:
    """Brake the joints, the leading one at `deceleration` [rad/s^2]. stopj."""
    if not deceleration > 0:
        raise ScriptError("stopj: the deceleration must be positive")
    momentum = arm.momentum
    q = arm.q
    while momentum.any():
        q, momentum = braked(q, momentum, deceleration, PERIOD_S)
        arm.command(q)
        if not momentum.any():
            arm.rest()
        yield


def stop_line(arm: Arm, deceleration: float) -> Thread:
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
        T = displaced(T, twist * (0.5 * (factor + after) * PERIOD_S))
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
