"""What the controller does with a program, or a command, that a client has sent."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim_twin.wire.ur.control_loop import ControlLoop
from sim_twin.wire.ur.program import Program, ScriptError
from sim_twin.wire.ur.reports import RuntimeException
from sim_twin.wire.ur.script_reader import Command, ControlScript, Refused, Script
from sim_twin.wire.ur.statements import run_at_once, run_statements

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_twin.wire.ur.controller import Controller
    from sim_twin.wire.ur.script_reader import Received

# What the controller puts before the reason why a secondary program died.
_SECONDARY = "SECONDARY_PROGRAM_EXCEPTION_XXX"

_COMMANDS: dict[str, Callable[[Controller], object]] = {
    "power on": lambda c: c.power_on(),
    "power off": lambda c: c.power_off(),
    "set robotmode run": lambda c: c.release_brakes(),
    "set unlock protective stop": lambda c: c.unlock_protective_stop(),
    "stop program": lambda c: c.stop_program(),
}


def launch(controller: Controller, received: Received) -> None:
    """Carry out what was understood, and report what was not."""
    match received:
        case ControlScript(register_offset, path):
            controller.start(ControlLoop(controller, register_offset, path).program)
        case Script(secondary=True):
            _run_secondary(controller, received)
        case Script(name):
            controller.start(Program(name, run_statements(controller, received.statements())))
        case Command(words):
            if controller.listens():
                _COMMANDS[words](controller)
        case Refused(error, secondary=True):
            _fail_secondary(controller, error)
        case Refused(error):
            controller.fail_program(error)


def _run_secondary(controller: Controller, script: Script) -> None:
    """The main program goes on, whatever becomes of a secondary one."""
    if not controller.listens():
        return
    try:
        run_at_once(controller, script.statements())
    except ScriptError as error:
        _fail_secondary(controller, error)


def _fail_secondary(controller: Controller, error: ScriptError) -> None:
    controller.reports.append(RuntimeException(error.line, _SECONDARY + error.words))
    controller.note("Secondary program stopped", str(error))
