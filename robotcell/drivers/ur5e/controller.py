"""What a UR controller says of itself, and what an operator must change before it can be driven from here."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotcell.drivers.ur5e.dashboard import Dashboard
from robotcell.drivers.ur5e.rtde import TIMEOUT_S, as_number, as_vector, open_rtde
from robotcell.errors import ConnectionLost
from robotcell.interfaces import ArmMode

if TYPE_CHECKING:
    from collections.abc import Sequence

SCRIPT_PORT = 30003
# Remote control can be asked for since 5.6, and ur_rtde reads the raw wrench since 5.9.
_OLDEST = (5, 9)
# Below this the arm moves so slowly that a motion looks like one that does not end.
_MIN_SPEED_FRACTION = 0.05

# Universal Robots, RTDE guide and client interface description.
_RUNNING = 7
_ROBOT_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "waiting for the confirmation of its safety configuration",
    2: "booting",
    3: "powered off",
    4: "powered on, brakes locked",
    5: "idle, brakes locked",
    6: "in backdrive",
    _RUNNING: "running",
    8: "updating its firmware",
}
PROTECTIVE_STOP = 3
_NORMAL_SAFETY = (1, 2)
_POWER_ON = "power it on and release the brakes at the pendant (on the bottom left: red dot > ON > START)"
_EMERGENCY_SAFETY = (6, 7)
_SAFETY_CURES = {
    4: "in recovery mode: a joint or the tool is outside its safety limits; move it back with freedrive at the pendant",
    5: "in a safeguard stop: close the guard, then press the reset at the cell",
    6: "in an emergency stop of the cell: release the button, then " + _POWER_ON,
    7: "in an emergency stop: release the button at the pendant, then " + _POWER_ON,
    8: "in a safety violation: restart its safety at the pendant",
    9: "in a safety fault: restart its safety at the pendant",
}
STOPPED, PLAYING = 1, 2
_PROGRAM_HELD = {PLAYING: "running", 3: "pausing", 4: "paused", 5: "resuming"}
_READ = ("robot_mode", "safety_mode", "runtime_state", "target_speed_fraction", "payload", "payload_cog", "tcp_offset")


@dataclass(frozen=True)
class Controller:
    """What a controller says of itself.

    Attributes:
        version: of PolyScope.
        model: of the arm, such as UR5.
        serial: of the arm.
        remote: whether it is in remote control.
        robot_mode, safety_mode, runtime_state: the controller's own numbers.
        speed_fraction: the speed slider, 0 to 1.
        payload_kg: what it takes the tool to weigh.
        payload_cog: (3,) [m] its centre of gravity, flange axes.
        tcp_offset: pose (6,) [m, rad] of the active tool centre point on the flange.
    """

    version: tuple[int, int, int, int]
    model: str
    serial: str
    remote: bool
    robot_mode: int
    safety_mode: int
    runtime_state: int
    speed_fraction: float
    payload_kg: float
    payload_cog: tuple[float, ...]
    tcp_offset: tuple[float, ...]

    @property
    def protective_stop(self) -> bool:
        """Whether it is in a protective stop."""
        return self.safety_mode == PROTECTIVE_STOP


def inspect(host: str) -> Controller:
    """Ask a controller. Changes nothing; every wait is bounded.

    Raises:
        ConnectionLost: a port cannot be reached, or what listens there does not answer as a UR controller does.
    """
    try:
        with open_rtde(host) as rtde:
            rtde.start(_READ, 125.0)
            values = rtde.read()
            version = rtde.version
        dashboard = Dashboard(host)
        try:
            dashboard.connect()
            model, serial = dashboard.ask("get robot model"), dashboard.ask("get serial number")
            remote = dashboard.ask("is in remote control").lower() == "true"
        finally:
            dashboard.close()
        _probe_script_port(host)
    except ConnectionLost as error:
        raise ConnectionLost(
            f"the arm: {error}; check that the controller has booted, arm.host, the cable, and that its services are "
            "enabled (Settings > Security > Services at the pendant)",
            device="arm",
        ) from None
    return Controller(
        version=version,
        model=model,
        serial=serial,
        remote=remote,
        robot_mode=int(as_number(values["robot_mode"])),
        safety_mode=int(as_number(values["safety_mode"])),
        runtime_state=int(as_number(values["runtime_state"])),
        speed_fraction=as_number(values["target_speed_fraction"]),
        payload_kg=as_number(values["payload"]),
        payload_cog=as_vector(values["payload_cog"]),
        tcp_offset=as_vector(values["tcp_offset"]),
    )


def obstacles(controller: Controller) -> list[str]:
    """Everything, a protective stop and a program apart, that keeps the arm from being driven, each with its cure."""
    found = []
    if not _OLDEST <= controller.version[:2] < (6, 0):
        found.append(
            f"it runs PolyScope {'.'.join(map(str, controller.version))}; versions from "
            f"{'.'.join(map(str, _OLDEST))} up to the last 5.x are supported: update or downgrade it at the pendant"
        )
    if not controller.model.upper().startswith("UR5"):
        found.append(f"it drives a {controller.model}; this cell is built around a UR5e: check arm.host")
    if not controller.remote:
        found.append(
            "it is in local control: enable Settings > System > Remote Control at the pendant, then switch from Local "
            "to Remote at the top right"
        )
    if controller.safety_mode in _SAFETY_CURES:
        found.append(f"it is {_SAFETY_CURES[controller.safety_mode]}")
    elif controller.robot_mode != _RUNNING:
        mode = _ROBOT_MODES.get(controller.robot_mode, f"in robot mode {controller.robot_mode}")
        found.append(f"it is {mode}: {_POWER_ON}")
    if not controller.speed_fraction >= _MIN_SPEED_FRACTION:
        found.append(slow_slider(controller.speed_fraction))
    return found


def program_held(runtime_state: int) -> str:
    """What another program on the controller does that keeps it from ours, with the cure; "" if there is none."""
    held = _PROGRAM_HELD.get(runtime_state)
    if held is None:
        return ""
    return f"a program is {held} on it: press Stop at the pendant, or run robotcell recover"


def slow_slider(speed_fraction: float) -> str:
    """Words for a speed slider that is too low; "" where it is not."""
    if speed_fraction >= _MIN_SPEED_FRACTION:
        return ""
    return (
        f"its speed slider is at {100 * speed_fraction:.0f} %: move it up at the pendant (at the bottom; at least "
        f"{100 * _MIN_SPEED_FRACTION:.0f} %)"
    )


def arm_mode(robot_mode: int, safety_mode: int, *, ready: bool) -> ArmMode:
    """The mode of an arm; `ready` says whether our program runs on its controller."""
    if safety_mode == PROTECTIVE_STOP:
        return ArmMode.PROTECTIVE_STOP
    if safety_mode in _EMERGENCY_SAFETY:
        return ArmMode.EMERGENCY_STOP
    if robot_mode == _RUNNING and safety_mode in _NORMAL_SAFETY and ready:
        return ArmMode.READY
    return ArmMode.NOT_READY


def why_not_ready(robot_mode: int, safety_mode: int) -> str:
    """What happened to an arm whose mode is not READY, and what to do."""
    if safety_mode == PROTECTIVE_STOP:
        return "the arm is in a protective stop: look at the cell, clear the contact, then run robotcell recover"
    if safety_mode in _SAFETY_CURES:
        return f"the arm is {_SAFETY_CURES[safety_mode]}; then run robotcell recover"
    if robot_mode != _RUNNING:
        mode = _ROBOT_MODES.get(robot_mode, f"in robot mode {robot_mode}")
        return f"the arm is {mode}: {_POWER_ON}; then run robotcell recover"
    return (
        "the arm's program was stopped or paused (at the pendant, by the watchdog, or by a motion that the controller "
        "cannot do), or another program is on it: look at the cell, then run robotcell recover"
    )


def inputs_in_use(host: str, names: Sequence[str]) -> list[str]:
    """Those of the input registers that another client or a fieldbus holds; the others are free again afterwards.

    Raises:
        ConnectionLost: as `inspect`.
    """
    with open_rtde(host) as rtde:
        return rtde.claim_inputs(names)


IN_USE_CURE = (
    "another client or a fieldbus holds the controller's RTDE inputs: end the other client (a second robotcell, a ROS "
    "driver), and disable Installation > Fieldbus > EtherNet/IP, PROFINET and MODBUS at the pendant"
)


def _probe_script_port(host: str) -> None:
    try:
        socket.create_connection((host, SCRIPT_PORT), TIMEOUT_S).close()
    except OSError as error:
        raise ConnectionLost(f"{host}:{SCRIPT_PORT} (script) cannot be reached: {error}", device="arm") from error
