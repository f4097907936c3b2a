"""The dashboard server of the controller: one line in, one line out, in the controller's own words.

Wording: Universal Robots, "Dashboard Server, e-Series", and what UR's own client library expects.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from typing import TYPE_CHECKING

from sim_twin.wire.ur.controller import MODEL, SERIAL_NUMBER, VERSION
from sim_twin.wire.ur.modes import RobotMode, RuntimeState, SafetyMode

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_twin.wire.ur.controller import Controller

GREETING = b"Connected: Universal Robots Dashboard Server\n"
SOFTWARE = f"URSoftware {'.'.join(map(str, VERSION))} (Mar 22 2022)"

_MAX_LINE = 4096
_NOT_ALLOWED = "Command is not allowed due to safety reasons"
_TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)
# Refused while the pendant is in local control. Which ones a real controller refuses is not documented in one place.
_REMOTE_ONLY = frozenset(
    {
        "play",
        "pause",
        "power on",
        "brake release",
        "unlock protective stop",
        "restart safety",
        "load",
        "load installation",
        "shutdown",
    }
)
_WITH_TEXT = (
    "load installation",
    "load",
    "popup",
    "addToLog",
    "set operational mode",
    "setUserRole",
    "generate flight report",
    "generate support file",
)
_OPERATIONAL_MODES = frozenset({"MANUAL", "AUTOMATIC"})
_FLIGHT_REPORTS = frozenset({"", "controller", "software", "system"})
_report_ids = itertools.count(1)


class DashboardSession:
    """The server's side of one connection.

    Attributes:
        ended: the client has said goodbye; close once the answers are sent.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._rest = b""
        self._lines: deque[bytes] = deque()
        self.ended = False

    def feed(self, data: bytes) -> None:
        """Take bytes in, whole lines or not."""
        *ended, rest = (self._rest + data).split(b"\n")
        self._lines.extend(ended)
        # A line without an end is never answered; it must not grow for ever.
        self._rest = rest[:_MAX_LINE]

    def step(self) -> bytes | None:
        """Obey the next whole line; the answer to it, None when there is none."""
        if not self._lines or self.ended:
            return None
        line = self._lines.popleft()[:_MAX_LINE].decode("latin-1").strip()
        return f"{self._answer(line)}\n".encode("latin-1", "replace")

    def _answer(self, line: str) -> str:
        command, text = _split(line)
        if command == "quit":
            self.ended = True
            return "Disconnected"
        act = _COMMANDS.get(command)
        if act is None:
            return f'could not understand: "{line}"'
        if command in _REMOTE_ONLY and not self._controller.remote:
            return _NOT_ALLOWED
        return act(self._controller, text)


def _split(line: str) -> tuple[str, str]:
    for command in _WITH_TEXT:
        if line == command or line.startswith(command + " "):
            return command, line[len(command) :].strip()
    return line, ""


def _play(controller: Controller, _: str) -> str:
    return "Starting program" if controller.resume_program() else "Failed to execute: play"


def _stop(controller: Controller, _: str) -> str:
    controller.stop_program()
    return "Stopped"


def _pause(controller: Controller, _: str) -> str:
    return "Pausing program" if controller.pause_program() else "Failed to execute: pause"


def _load(_: Controller, text: str) -> str:
    return f"File not found: {text}"


def _running(controller: Controller, _: str) -> str:
    return f"Program running: {'true' if controller.runtime is RuntimeState.PLAYING else 'false'}"


def _state(controller: Controller, _: str) -> str:
    word = {RuntimeState.PLAYING: "PLAYING", RuntimeState.PAUSING: "PAUSED", RuntimeState.PAUSED: "PAUSED"}.get(
        controller.runtime, "STOPPED"
    )
    return f"{word} {_program(controller)}"


def _saved(controller: Controller, _: str) -> str:
    return f"true {_program(controller)}"


def _program(controller: Controller) -> str:
    return controller.program.name if controller.program else "null"


def _set_operational_mode(controller: Controller, text: str) -> str:
    if text.upper() not in _OPERATIONAL_MODES:
        return f"Failed setting operational mode: {text}"
    controller.operational_mode = text.upper()
    return f"Operational mode {text} is set"


def _clear_operational_mode(controller: Controller, _: str) -> str:
    controller.operational_mode = "NONE"
    return "No longer controlling the operational mode. Current operational mode: 'NONE'."


def _flight_report(_: Controller, text: str) -> str:
    if text.lower() not in _FLIGHT_REPORTS:
        return f"Error generating flight report: {text}"
    return f"Flight Report generated with id: {next(_report_ids)}"


def _support_file(_: Controller, text: str) -> str:
    if not text:
        return "Error: no directory was given"
    return f"Completed successfully: ur_{SERIAL_NUMBER}_{time.strftime('%Y-%m-%d_%H-%M-%S')}.zip"


def _popup(controller: Controller, text: str) -> str:
    controller.popup = text
    return "showing popup"


def _close_popup(controller: Controller, _: str) -> str:
    controller.popup = None
    return "closing popup"


def _close_safety_popup(controller: Controller, _: str) -> str:
    controller.popup = None
    return "closing safety popup"


def _log(controller: Controller, text: str) -> str:
    controller.note("log", text)
    return "Added log message"


def _power_on(controller: Controller, _: str) -> str:
    controller.power_on()
    return "Powering on"


def _power_off(controller: Controller, _: str) -> str:
    controller.power_off()
    return "Powering off"


def _release(controller: Controller, _: str) -> str:
    controller.release_brakes()
    return "Brake releasing"


def _unlock(controller: Controller, _: str) -> str:
    return "Protective stop releasing" if controller.unlock_protective_stop() else _TOO_EARLY


def _restart_safety(controller: Controller, _: str) -> str:
    controller.restart_safety()
    return "Restarting safety"


def _shut_down(controller: Controller, _: str) -> str:
    controller.power_off()
    return "Shutting down"


_COMMANDS: dict[str, Callable[[Controller, str], str]] = {
    "play": _play,
    "stop": _stop,
    "pause": _pause,
    "load": _load,
    "load installation": _load,
    "running": _running,
    "programState": _state,
    "get loaded program": lambda _, __: "No program loaded",
    "isProgramSaved": _saved,
    "popup": _popup,
    "close popup": _close_popup,
    "close safety popup": _close_safety_popup,
    "addToLog": _log,
    "robotmode": lambda c, _: f"Robotmode: {RobotMode(c.robot_mode).name}",
    "safetymode": lambda c, _: f"Safetymode: {SafetyMode(c.safety_mode).name}",
    "safetystatus": lambda c, _: f"Safetystatus: {SafetyMode(c.safety_mode).name}",
    "PolyscopeVersion": lambda _, __: SOFTWARE,
    "version": lambda _, __: SOFTWARE,
    "get serial number": lambda _, __: SERIAL_NUMBER,
    "get robot model": lambda _, __: MODEL,
    "is in remote control": lambda c, _: "true" if c.remote else "false",
    "get operational mode": lambda c, _: c.operational_mode,
    "set operational mode": _set_operational_mode,
    "clear operational mode": _clear_operational_mode,
    "saveLog": lambda _, __: "Log saved to disk",
    "generate flight report": _flight_report,
    "generate support file": _support_file,
    "setUserRole": lambda _, text: f"Setting user role: {text}",
    "getUserRole": lambda _, __: "PROGRAMMER",
    "power on": _power_on,
    "power off": _power_off,
    "brake release": _release,
    "unlock protective stop": _unlock,
    "restart safety": _restart_safety,
    "shutdown": _shut_down,
}
