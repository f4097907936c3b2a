"""`robotcell stop` and `robotcell recover`: stopping another command, and what follows a stop."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from typing import TYPE_CHECKING

import numpy as np
import typer
from rich.text import Text

from cli.console import progress, report_error, results
from robotcell.config import find_backend
from robotcell.errors import CellError, ConfigError, DeviceFault, UnsafeMotion
from robotcell.interfaces import ArmMode
from robotcell.io.lock_file import holder
from robotcell.jobs.journal import Journal
from robotcell.jobs.opening import open_cell
from robotcell.motion.plan import LinearMove

if TYPE_CHECKING:
    from cli.options import CellChoice
    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.guard import Stop
    from robotcell.motion.path_check import CheckedPlan

_STOPPED = 3
# A command that is told to stop has ended after 2 s.
_ENDS_S = 10.0
_POLL_S = 0.05
_NO_EMERGENCY_STOP = "This is no emergency stop: use the button where somebody is in danger."
# A joint that differs by more than this from where it was measured at the stop was moved.
_MOVED_RAD = 0.02


def run_stop(choice: CellChoice) -> int:
    """Stop the command that has the cell open; returns the exit code."""
    try:
        config = choice.load()
        name = find_backend(config.backend.name).cell_name(config)
        if name is None:
            raise ConfigError("a twin without servers is driven by no other command: end the one that has it by Ctrl-C")
        progress().print(_NO_EMERGENCY_STOP, style="bold")
        owner = holder(name)
        if owner is None:
            results().print("no command has the cell open; none is to be stopped")
            return 0
        if owner.host != socket.gethostname():
            raise DeviceFault(f"the cell is in use by {owner}: run robotcell stop there")
        try:
            os.kill(owner.pid, signal.SIGINT)
        except OSError as error:
            raise DeviceFault(f"{owner} cannot be told to stop: {error.strerror}") from error
        deadline = time.monotonic() + _ENDS_S
        while (now := holder(name)) is not None and now.token == owner.token:
            if time.monotonic() > deadline:
                raise DeviceFault(f"{owner} has not let go of the cell in {_ENDS_S:.0f} s: use the emergency stop")
            time.sleep(_POLL_S)
        results().print(Text(f"stopped: {owner}"), soft_wrap=True)
        for line in _on_record(config, name):
            results().print(Text(line), soft_wrap=True)
    except CellError as error:
        return report_error(error)
    return 0


def run_recover(choice: CellChoice, *, yes: bool) -> int:
    """Take the cell out of a stop, once the operator has looked at it; returns the exit code."""
    try:
        cell = open_cell(choice.load())
        with cell.opened_to_recover():
            stop = cell.latch.stop
            if stop is None and _is_ready(cell):
                results().print("no stop stands, and arm and gripper are ready: there is nothing to recover from")
                return 0
            for line in (*_what_happened(cell, stop), *_what_will_happen(cell)):
                progress().print(Text(line), soft_wrap=True)
            if not _consent(yes=yes):
                progress().print("nothing was changed, and nothing moved")
                return _STOPPED
            with progress().status("leaving the stop, and going home slowly"):
                cell.recover()
            results().print(Text(f"the arm is {cell.arm.state().mode.value}, and no stop stands"))
            for line in _what_next(cell, stop):
                results().print(Text(line), soft_wrap=True)
    except CellError as error:
        return report_error(error)
    return 0


def _on_record(config: CellConfig, name: str) -> list[str]:
    """What the journal says of the command that was stopped."""
    place = config.journal
    if place.url is None and not place.default_file.exists():
        return []
    with Journal(place.database_url()) as journal:
        job, stop = journal.newest_job(name), journal.standing_stop(name)
    lines = [f"job {job.id} is {job.status}: {job.reason}; robotcell resume goes on with it"] if job else []
    if stop is not None:
        lines.append(f"a motion was cut short ({stop.what}): robotcell recover comes first")
    return lines


def _is_ready(cell: Cell) -> bool:
    try:
        cell.gripper.connect()
    except DeviceFault:
        return False
    return cell.arm.state().mode is ArmMode.READY


def _what_happened(cell: Cell, stop: Stop | None) -> list[str]:
    state = cell.arm.state()
    lines = [f"the arm is {state.mode.value}, joints 1 to 6 at {_degrees(state.q)} degrees"]
    if stop is None:
        return ["no stop of this program stands, but a device is stopped", *lines]
    job = f", in job {stop.job}" if stop.job is not None else ""
    lines.insert(0, f"stopped {stop.at:%Y-%m-%d %H:%M:%S} UTC{job}: {stop.what}")
    if stop.q is not None and float(np.abs(stop.q - state.q).max()) > _MOVED_RAD:
        lines.append(f"it was moved since: it stood at {_degrees(stop.q)} degrees")
    return lines


def _what_will_happen(cell: Cell) -> list[str]:
    """In words; the way is checked now, and once more before the arm moves."""
    leave = "then: leave the stop of arm and gripper"
    try:
        plan = cell.recovery()
    except UnsafeMotion as error:
        return [f"{leave}. The arm will not move, since its way home is not safe: {error}"]
    moves = _moves(plan)
    return [f"{leave}, and, the fingers as they are, {moves}" if moves else f"{leave}. The arm is home and stays there"]


def _moves(plan: CheckedPlan) -> str:
    words = []
    for step, path in zip(plan.plan.steps, plan.joint_paths, strict=True):
        if isinstance(step, LinearMove):
            words.append(f"straight up to z {step.T_base_tcp[2, 3]:.2f} m at {1000 * step.speed_m_s:.0f} mm/s")
        else:
            turn = float(np.degrees(np.abs(path[-1] - path[0]).max()))
            words.append(f"home, no joint turning by more than {turn:.0f} degrees, slowly")
    return ", ".join(words)


def _consent(*, yes: bool) -> bool:
    """Whether a person says yes; `--yes` speaks for one only where nobody sits at a terminal."""
    if yes and not sys.stdin.isatty():
        return True
    question = "Is the cell clear, nobody within reach of the arm, and nothing touching it?"
    try:
        return typer.confirm(question, err=True)
    except typer.Abort:
        return False


def _what_next(cell: Cell, stop: Stop | None) -> list[str]:
    resume = f"robotcell resume {stop.job}" if stop is not None and stop.job is not None else ""
    state = cell.gripper.state()
    lines = [f"{resume} goes on with the job"] if resume else []
    if state.grip_detected and state.width_m >= cell.config.gripper.empty_width_m:
        held = f"the gripper holds something {1000 * state.width_m:.0f} mm wide"
        lines.append(f"{held}: {'resume carries it on, or ' if resume else ''}take it out by hand")
    return lines


def _degrees(q: Array) -> str:
    return ", ".join(f"{angle:.0f}" for angle in np.degrees(q))
