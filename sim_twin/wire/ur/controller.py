"""The UR controller itself: modes, safety, the running program and the arm, one control period at a time.

It knows nothing of sockets. What is not public it assumes: how long power and brakes take, and that a protective or
safeguard stop pauses the program.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sim_twin.devices.arm_limits import LEAVING_FORCE_N, PROTECTIVE_FORCE_N, TRACKING_ERROR_RAD
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.arm import Arm
from sim_twin.wire.ur.history import History
from sim_twin.wire.ur.modes import RobotMode, RuntimeState, SafetyMode
from sim_twin.wire.ur.program import ScriptError
from sim_twin.wire.ur.registers import Outputs, Payload, Registers
from sim_twin.wire.ur.reports import ErrorCode, ProgramEvent, RuntimeException, SafetyChange, Text

if TYPE_CHECKING:
    from collections.abc import Container, Sequence

    from robotcell.geometry.transforms import Array
    from sim_twin.wire.ur.program import Program
    from sim_twin.wire.ur.reports import Report

VERSION = (5, 12, 0, 1101319)
SERIAL_NUMBER = "20225500001"
MODEL = "UR5"

# Universal Robots, script manual: a protective stop can be left after 5 s.
UNLOCK_AFTER_S = 5.0
# How long the joints take to boot, and the brakes to open. Assumed; the real ones take several seconds.
_POWER_ON_S = 0.5
_BRAKE_RELEASE_S = 0.5
# How fast slider and pause change the speed, per second: an arm at full joint speed then brakes at 19 rad/s^2.
_RATE_SLOPE = 6.0
# What the arm does is compared with the targets of this many periods before it was measured: it follows with a delay.
_TRACKING_PERIODS = 20
# When the world has not stepped for so long, the time of motions stands still too; the arm could not follow them.
_WORLD_STALLS_S = 0.015
# Universal Robots, service manual, error codes: C153 "position deviates from path", whose argument is the joint from 0,
# and C157 "collision detected by joint"; -1 stands for no argument.
_DEVIATES_FROM_PATH, _COLLISION = 153, 157
_NO_ARGUMENT = -1


@dataclass
class Watchdog:
    """rtde_set_watchdog: the program ends when an input variable is not written in time."""

    variable: str
    period_s: float
    written_at: float


class Controller:
    """The controller of one arm.

    Args:
        q: (6,) joint angles [rad] at the start.
        unlock_after_s: how long after a protective stop it can be left.

    Attributes:
        time: seconds since the controller started.
        execution_time: how long the whole last period took its process [s].
        reports: what happened, for the clients that read messages; the server takes them out.
        remote: whether the pendant is in remote control.
        slider: the speed slider, 0 to 1.
        operational_mode: MANUAL or AUTOMATIC where a client has set it, else NONE.
        program: that runs, or is paused.
        history: what was measured lately.
    """

    def __init__(self, q: Array, unlock_after_s: float = UNLOCK_AFTER_S) -> None:
        self.arm = Arm(q)
        self.registers = Registers()
        self.outputs = Outputs()
        self.payload = Payload()
        self.gravity: tuple[float, ...] = (0.0, 0.0, 9.82)
        self._unlock_after_s = unlock_after_s
        self.time = 0.0
        self.execution_time = 0.0
        self.ticks = 0
        self.reports: deque[Report] = deque(maxlen=100)
        self.remote = True
        self.slider = 1.0
        self.operational_mode = "NONE"
        self.program: Program | None = None
        self.watchdog: Watchdog | None = None
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.runtime = RuntimeState.STOPPED
        self.popup: str | None = None
        # What a fault holds as it is.
        self.frozen_slider: float | None = None
        self.tcp_frozen = False
        self.payload_frozen = False
        self._rate = 1.0
        self._force_n = 0.0
        self._power_at: float | None = None
        self._brakes_at: float | None = None
        self._stopped_at = -math.inf
        self._force_limit_n = PROTECTIVE_FORCE_N
        self._targets = np.tile(self.arm.q, (64, 1))
        self.history = History(self.arm.q)

    # What the arm does

    def tick(self, now: float, cell: np.void) -> None:
        """One control period.

        Args:
            now: time.monotonic() [s].
            cell: the newest CELL_STATE.
        """
        self.ticks += 1
        self.time = self.ticks * PERIOD_S
        self._measure(cell)
        self._switch_power()
        self._watch_safety(now - float(cell["wall"]))
        self._watch_client()
        self._set_rate(now - float(cell["wall"]))
        was_steady = self.arm.steady
        if self.program is not None and self.runtime in (RuntimeState.PLAYING, RuntimeState.PAUSING):
            self._run_program(self.program)
        if not self.powered:
            self.arm.hold()
        self.arm.finish_period()
        if was_steady and not self.arm.steady:
            self._allow_leaving(cell)
        self._targets[self.ticks % len(self._targets)] = self.arm.q

    def skip(self, ticks: int) -> None:
        """Let time pass without doing anything: the process was held up."""
        self.ticks += ticks
        self._targets[:] = self.arm.q
        if self.watchdog is not None:
            self.watchdog.written_at += ticks * PERIOD_S

    @property
    def powered(self) -> bool:
        """Whether the joints hold or follow the target; else the brakes hold them."""
        return self.robot_mode is RobotMode.RUNNING

    @property
    def safe(self) -> bool:
        """Whether no safety function has stopped the arm."""
        return self.safety_mode is SafetyMode.NORMAL

    @property
    def speed_fraction(self) -> float:
        """What the speed slider stands at."""
        return self.slider if self.frozen_slider is None else self.frozen_slider

    # What the program is told

    def listens(self) -> bool:
        """Whether scripts from outside are taken."""
        if not self.remote:
            self.note("Program rejected", "the robot is in local control: switch the pendant to remote control")
        return self.remote

    def start(self, program: Program) -> bool:
        """Run a program instead of the one that runs; whether the controller takes it."""
        if not self.listens():
            return False
        if not self.powered or not self.safe:
            self.note("Program rejected", f"the robot is in {self.robot_mode.name}, {self.safety_mode.name}")
            return False
        self.stop_program()
        self.program = program
        self.runtime = RuntimeState.PLAYING
        self.reports.append(ProgramEvent(program.name, started=True))
        return True

    def stop_program(self, reason: str | None = None) -> None:
        """End the program; the arm brakes. Does nothing when none runs."""
        if reason is not None:
            self.note("Program stopped", reason)
        if self.program is None:
            return
        self.reports.append(ProgramEvent(self.program.name, started=False))
        self.program = None
        self.watchdog = None
        self.arm.freedrive = False
        self.arm.force_mode = None
        self.runtime = RuntimeState.STOPPED

    def fail_program(self, error: ScriptError) -> None:
        """Say why a program was refused or has died, and end the one that runs."""
        self.reports.append(RuntimeException(error.line, error.words))
        self.stop_program(str(error))

    def pause_program(self) -> bool:
        """Bring the arm to a standstill on its path and the program with it; whether one runs."""
        if self.runtime is not RuntimeState.PLAYING:
            return self.runtime is RuntimeState.PAUSED
        self.runtime = RuntimeState.PAUSING
        return True

    def resume_program(self) -> bool:
        """Go on with a paused program; whether that is possible."""
        if self.runtime is not RuntimeState.PAUSED or not self.powered or not self.safe:
            return False
        self.runtime = RuntimeState.PLAYING
        return True

    def wrote(self, names: Container[str]) -> None:
        """Take note that a client has written some input variables."""
        if self.watchdog is not None and self.watchdog.variable in names:
            self.watchdog.written_at = self.time

    def note(self, title: str, text: str) -> None:
        """Tell the clients that read messages."""
        self.reports.append(Text(f"{title}: {text}"))

    def set_tcp(self, tcp: Sequence[float]) -> None:
        """Take another tool centre point."""
        if not self.tcp_frozen:
            self.arm.set_tcp(tcp)

    def set_payload(self, payload: Payload) -> None:
        """Take another payload."""
        if not self.payload_frozen:
            self.payload = payload

    # What the operator and the safety system do

    def power_on(self) -> None:
        """Boot the joints; takes a while."""
        if self.robot_mode is RobotMode.POWER_OFF and self.safety_mode in (
            SafetyMode.NORMAL,
            SafetyMode.SAFEGUARD_STOP,
        ):
            self.robot_mode = RobotMode.POWER_ON
            self._power_at = self.time + _POWER_ON_S

    def power_off(self) -> None:
        """Cut the power; the brakes fall in."""
        self.stop_program()
        self._power_at = self._brakes_at = None
        self.robot_mode = RobotMode.POWER_OFF

    def release_brakes(self) -> None:
        """Open the brakes, after powering on where that has not been done."""
        self.power_on()
        if self.robot_mode in (RobotMode.POWER_ON, RobotMode.IDLE):
            begin = self.time if self._power_at is None else self._power_at
            self._brakes_at = begin + _BRAKE_RELEASE_S

    def protective_stop(self, reason: str, code: int | None = None, argument: int = _NO_ARGUMENT) -> None:
        """Stop at once, for good until it is unlocked; the program is paused.

        Args:
            reason: in plain words.
            code: of the service manual, where it has one.
            argument: that goes with it.
        """
        if self.safety_mode is not SafetyMode.NORMAL:
            return
        cause = None if code is None else ErrorCode(code, argument, reason)
        if cause is not None:
            self.reports.append(cause)
        self._enter(SafetyMode.PROTECTIVE_STOP, cause)
        self._stopped_at = self.time
        self.arm.hold()
        self._halt_program()
        self.popup = reason
        self.note("Protective stop", reason)

    def unlock_protective_stop(self) -> bool:
        """Leave a protective stop; False before it can be left. The program stays paused."""
        if self.safety_mode is not SafetyMode.PROTECTIVE_STOP:
            return True
        if self.time - self._stopped_at < self._unlock_after_s:
            return False
        self._enter(SafetyMode.NORMAL)
        # Somebody may have moved the arm meanwhile.
        self.arm.hold()
        self._targets[:] = self.arm.q
        self._force_limit_n = max(PROTECTIVE_FORCE_N, self._force_n + LEAVING_FORCE_N)
        return True

    def safeguard_stop(self) -> None:
        """Stop on the path as long as the safeguard input is open."""
        if self.safe:
            self._enter(SafetyMode.SAFEGUARD_STOP)
            self.pause_program()

    def emergency_stop(self, mode: SafetyMode = SafetyMode.ROBOT_EMERGENCY_STOP) -> None:
        """Stop, cut the power and end the program. The button is pressed, or a safety limit was violated."""
        self._enter(mode)
        self.power_off()

    def restart_safety(self) -> None:
        """Leave a violation; the arm is without power then."""
        if self.safety_mode is SafetyMode.VIOLATION:
            self._enter(SafetyMode.NORMAL)

    def boot(self) -> None:
        """Be as a controller that has just been switched on."""
        self.power_off()
        self.robot_mode = RobotMode.BOOTING

    def restore(self) -> None:
        """Be ready again, as after all that an operator does at the pendant."""
        self._enter(SafetyMode.NORMAL)
        self._power_at = self._brakes_at = None
        self.robot_mode = RobotMode.RUNNING

    def _enter(self, mode: SafetyMode, cause: ErrorCode | None = None) -> None:
        if mode is not self.safety_mode:
            self.safety_mode = mode
            self.reports.append(SafetyChange(mode, cause))

    def _measure(self, cell: np.void) -> None:
        self.arm.measure(cell["q"], cell["qd"], cell["wrench"])
        self._force_n = math.hypot(*cell["robot_force"].tolist())
        self.history.add(self.arm.measured_q, self.arm.tcp_wrench[:3])

    def _switch_power(self) -> None:
        if self._power_at is not None and self.time >= self._power_at:
            self.robot_mode, self._power_at = RobotMode.IDLE, None
        if self._brakes_at is not None and self.time >= self._brakes_at:
            self.robot_mode, self._brakes_at = RobotMode.RUNNING, None

    def _watch_safety(self, age: float) -> None:
        if not self.powered or self.safety_mode is SafetyMode.PROTECTIVE_STOP:
            return
        if self._force_n > self._force_limit_n:
            self.protective_stop(f"the arm was pushed with {self._force_n:.0f} N", _COLLISION)
            return
        # The targets of the periods just before the measurement.
        newest = self.ticks - 1 - min(round(age / PERIOD_S), len(self._targets) - _TRACKING_PERIODS - 1)
        window = self._targets[np.arange(newest - _TRACKING_PERIODS, newest + 1) % len(self._targets)]
        q = self.arm.measured_q
        errors = np.maximum(window.min(axis=0) - q, q - window.max(axis=0))
        joint = int(errors.argmax())
        if errors[joint] > TRACKING_ERROR_RAD:
            reason = f"joint {joint + 1} is {errors[joint]:.2f} rad from where it should be"
            self.protective_stop(reason, _DEVIATES_FROM_PATH, joint)

    def _watch_client(self) -> None:
        dog = self.watchdog
        if dog is not None and self.runtime is RuntimeState.PLAYING and self.time - dog.written_at > dog.period_s:
            self.stop_program(f"the watchdog of {dog.variable} has not been served for {dog.period_s:.3f} s")

    def _set_rate(self, age: float) -> None:
        wanted = 0.0 if self.runtime in (RuntimeState.PAUSING, RuntimeState.PAUSED) else self.speed_fraction
        step = _RATE_SLOPE * PERIOD_S
        self._rate = min(max(wanted, self._rate - step), self._rate + step)
        self.arm.rate = 0.0 if age > _WORLD_STALLS_S else self._rate
        if self.runtime is RuntimeState.PAUSING and self._rate == 0:
            self.arm.rest()
            self.runtime = RuntimeState.PAUSED

    def _run_program(self, program: Program) -> None:
        try:
            running = program.step()
        except ScriptError as error:
            self.fail_program(error)
            return
        if not running:
            self.stop_program()

    def _halt_program(self) -> None:
        if self.program is not None:
            self.runtime = RuntimeState.PAUSED
            self._rate = 0.0

    def _allow_leaving(self, cell: np.void) -> None:
        """Let an arm that starts to move press a little more than at the start, so that it can leave a contact."""
        at_start = float(np.linalg.norm(cell["robot_force"]))
        self._force_limit_n = max(PROTECTIVE_FORCE_N, at_start + LEAVING_FORCE_N)
