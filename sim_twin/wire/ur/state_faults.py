"""Faults in the state of the arm: what an operator or the safety system has done, or the controller fails to do.

Conditions hold while they are injected; lifting one stands for what an operator does at the pendant: the arm is ready
again. Stops of the program are events: they happen once, when they are injected. A protective stop stays until it is
unlocked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim_twin.wire.faults import Kind
from sim_twin.wire.ur.modes import RobotMode, SafetyMode
from sim_twin.wire.ur.pose import ZERO_POSE
from sim_twin.wire.ur.registers import Payload

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_twin.wire.faults import FaultInbox
    from sim_twin.wire.ur.controller import Controller

# A tcp and a payload that nobody has asked for: 50 mm off, 1 kg too much.
_WRONG_TCP = (0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
_WRONG_PAYLOAD_KG = 1.0


def _lock_brakes(controller: Controller) -> None:
    controller.power_off()
    controller.robot_mode = RobotMode.IDLE


_CONDITIONS: dict[str, Callable[[Controller], None]] = {
    "power_off": lambda c: c.power_off(),
    "brakes_locked": _lock_brakes,
    "booting": lambda c: c.boot(),
    "safeguard_stop": lambda c: c.safeguard_stop(),
    "emergency_stop": lambda c: c.emergency_stop(),
    "violation": lambda c: c.emergency_stop(SafetyMode.VIOLATION),
}
_EVENTS: dict[str, Callable[[Controller], object]] = {
    "protective_stop": lambda c: c.protective_stop("the arm was stopped by a fault that was asked for"),
    "program_stopped": lambda c: c.stop_program("stopped at the pendant"),
    "program_paused": lambda c: c.pause_program(),
}
_SETTINGS = ("local_control", "speed_slider", "never_arrives", "tcp", "payload")

STATE_FAULTS = frozenset({*_CONDITIONS, *_EVENTS, *_SETTINGS})


class StateFaults:
    """Carries faults of the state into a controller.

    Args:
        controller: that has them.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._active: frozenset[str] = frozenset()

    def apply(self, inbox: FaultInbox) -> None:
        """Bring the controller into line with what is injected now."""
        controller = self._controller
        active = frozenset(what for what in STATE_FAULTS if inbox.find("state", Kind.WRONG, what))
        begun = active - self._active
        if any(what in _CONDITIONS for what in self._active - active):
            controller.restore()
            # Those that stay hold on.
            begun = begun | (active & _CONDITIONS.keys())
        for what in sorted(begun):
            act = _CONDITIONS.get(what) or _EVENTS.get(what)
            if act is not None:
                act(controller)
        controller.remote = "local_control" not in active
        slider = inbox.find("state", Kind.WRONG, "speed_slider")
        controller.frozen_slider = None if slider is None else min(max(slider.value or 0.0, 0.0), 1.0)
        controller.arm.arrives = "never_arrives" not in active
        controller.arm.reachable = inbox.find("ik", Kind.WRONG, "none") is None
        self._freeze(active)
        self._active = active

    def _freeze(self, active: frozenset[str]) -> None:
        """Hold tcp and payload at values that nobody has asked for."""
        controller = self._controller
        if ("tcp" in active) != controller.tcp_frozen:
            controller.tcp_frozen = "tcp" in active
            controller.arm.set_tcp(_WRONG_TCP if controller.tcp_frozen else ZERO_POSE)
        if ("payload" in active) != controller.payload_frozen:
            controller.payload_frozen = "payload" in active
            controller.payload = Payload(_WRONG_PAYLOAD_KG if controller.payload_frozen else 0.0)
