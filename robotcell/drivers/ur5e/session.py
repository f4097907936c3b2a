"""One session with a controller through ur_rtde: publishes its data, starts and stops motions, kicks its watchdog.

Runs in the child process only. One thread does everything, so that a command never meets another one.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from robotcell.drivers.ur5e.clock_offset import ClockOffset
from robotcell.drivers.ur5e.controller import IN_USE_CURE, PLAYING, PROTECTIVE_STOP, STOPPED
from robotcell.drivers.ur5e.messages import STATE, SUPERVISION, SUPERVISION_OFFSET, StartJoints, StartPath
from robotcell.errors import ConnectionLost
from robotcell.interfaces import KICK_TIMEOUT_S
from robotcell.io.shared_record import SharedRecord

if TYPE_CHECKING:
    from mmap import mmap

    from robotcell.drivers.ur5e.messages import Setup, StartLinear

STATE_HZ = 125.0
_CONTROL_HZ = 500.0
_POLL_S = 0.004
_VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_force",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "target_speed_fraction",
    "payload",
    "payload_cog",
]
# The controller ends our program when no packet came for 1 / this: while a motion is under way, and while the arm
# stands, when a busy computer must not cost the program.
_MOVING_WATCHDOG_HZ = 8.0
_IDLE_WATCHDOG_HZ = 1.0
_KICK_PERIOD_S = 0.02
_PROGRAM_STARTS_S = 4.0
_SETTING_APPLIES_S = 1.0
# The number that our program reports before its first operation; each path sends the program anew.
_NO_OPERATION = 0
# A motion that was accepted begins within some milliseconds.
_MOTION_BEGINS_S = 0.5
_LAST_STOP_S = 0.6
# What ur_rtde brakes with unless told otherwise [m/s^2].
_STOP_DECELERATION_M_S2 = 10.0
_STANDS_RAD_S = 0.015
_SETTLES_S = 0.2
# Uploading is left to us: with the library's default its own thread uploads the program again after a lost connection.
_FLAG_NO_WAIT = 16


class Session:
    """A connected controller.

    Args:
        setup: what to connect to.
        memory: both records: what is published, and the driver's supervision.
    """

    def __init__(self, setup: Setup, memory: mmap) -> None:
        from rtde_receive import RTDEReceiveInterface

        self._state = SharedRecord(STATE, memory)
        self._supervision = SharedRecord(SUPERVISION, memory, SUPERVISION_OFFSET)
        self._offset = ClockOffset()
        self._stamp = 0.0
        self._stopped_at = 0.0
        self._receive = RTDEReceiveInterface(setup.host, STATE_HZ, _VARIABLES)
        self._control: Any = None
        # Set for good when our program is interrupted: a program that is resumed at the pendant is never kicked again.
        self._interrupted = False
        self._moving = False
        self._watchdog_hz = _IDLE_WATCHDOG_HZ
        # Number of the operation before the one that moves the arm or brakes it, and when that was commanded.
        self._operation = 0
        self._commanded_at = 0.0
        self._ended_at = math.inf
        self._stops = 0
        self._stop_sent = False
        self._kick_due = 0.0
        self._publish()

    def take_control(self, setup: Setup) -> str:
        """Start our program and set the tool; "" or why that was refused."""
        from rtde_control import RTDEControlInterface

        try:
            self._control = RTDEControlInterface(setup.host, _CONTROL_HZ, _FLAG_NO_WAIT)
        except RuntimeError as error:
            return IN_USE_CURE if "in use" in str(error) else f"the controller refuses to be controlled: {error}"
        self._control.reuploadScript()
        if not _wait_for(self._playing, _PROGRAM_STARTS_S):
            return (
                "the controller does not start the program that was sent to it: look at the pendant for a message, "
                "and check that the arm is powered on and in remote control"
            )
        if not self._control.setTcp(list(setup.tcp_offset)) or not _close(
            self._control.getTCPOffset(), setup.tcp_offset
        ):
            return "the controller does not take the tool's centre point: check the installation at the pendant"
        cog = list(setup.payload_cog)
        payload_set = self._control.setPayload(setup.payload_kg, cog) and _wait_for(
            lambda: (
                _close([self._receive.getPayload()], [setup.payload_kg]) and _close(self._receive.getPayloadCog(), cog)
            ),
            _SETTING_APPLIES_S,
        )
        if not payload_set:
            return "the controller does not take the tool's mass: check arm.payload_kg and arm.payload_cog"
        if not self._control.setWatchdog(_IDLE_WATCHDOG_HZ):
            return "the controller does not arm its watchdog"
        self._publish()
        return ""

    def publish(self) -> None:
        """Write the newest data package, and what we know of the motion.

        Raises:
            ConnectionLost: the controller closed a connection, or does not begin a motion that it took. What ur_rtde
                does after that ends in a crash: leave at once.
        """
        if not self._receive.isConnected() or not (self._control is None or self._control.isConnected()):
            raise ConnectionLost("the controller closed the connection", device="arm")
        self._publish()

    def _publish(self) -> None:
        """Write the newest data package, and what we know of the motion."""
        receive = self._receive
        stamp = receive.getTimestamp()
        while True:
            fields = {
                "q": receive.getActualQ(),
                "qd": receive.getActualQd(),
                "tcp_pose": receive.getActualTCPPose(),
                "tcp_force": receive.getActualTCPForce(),
                "robot_mode": receive.getRobotMode(),
                "safety_mode": receive.getSafetyMode(),
                "runtime_state": receive.getRuntimeState(),
                "speed_fraction": receive.getTargetSpeedFraction(),
            }
            before, stamp = stamp, receive.getTimestamp()
            if stamp == before:
                break
        if stamp != self._stamp:
            self._stamp = stamp
            fields["t"] = self._offset.to_local(stamp)
        if fields["safety_mode"] != PROTECTIVE_STOP:
            self._stopped_at = 0.0
        elif not self._stopped_at:
            self._stopped_at = time.monotonic()
        if self._control is not None:
            self._judge_motion(fields["qd"])
        self._state.write(
            **fields,
            ready=self._control is not None and not self._interrupted,
            moving=self._moving,
            stops=self._stops,
            stopped_at=self._stopped_at,
        )

    def _playing(self) -> bool:
        return bool(self._receive.getRuntimeState() == PLAYING and self._control.isProgramRunning())

    def _judge_motion(self, qd: list[float]) -> None:
        """Whether the motion under way has ended, by its operation number or because the program was interrupted."""
        if not self._playing():
            self._interrupted = True
            self._moving = self._moving and max(map(abs, qd)) > _STANDS_RAD_S
        elif self._moving:
            status = self._control.getAsyncOperationProgressEx()
            if status.operationId() != self._operation:
                if status.isAsyncOperationRunning():
                    self._ended_at = math.inf
                else:
                    # The joints follow their targets with a delay: the motion ends when they stand.
                    self._ended_at = min(self._ended_at, time.monotonic())
                    settled = max(map(abs, qd)) < _STANDS_RAD_S
                    self._moving = not settled and time.monotonic() - self._ended_at < _SETTLES_S
            elif time.monotonic() - self._commanded_at > _MOTION_BEGINS_S:
                raise ConnectionLost("the controller took a motion and did not begin it", device="arm")

    def start(self, motion: StartJoints | StartLinear | StartPath) -> str:
        """Start a motion; "" or why that was refused."""
        if self._control is None or self._interrupted:
            return "the controller does not run our program"
        if isinstance(motion, StartPath):
            return self._start_path(motion)
        if not self._set_watchdog(_MOVING_WATCHDOG_HZ):
            return "the controller did not arm its watchdog"
        operation = self._control.getAsyncOperationProgressEx().operationId()
        if isinstance(motion, StartJoints):
            taken = self._control.moveJ(list(motion.q), motion.speed_rad_s, motion.acceleration_rad_s2, True)
        else:
            taken = self._control.moveL(list(motion.tcp_pose), motion.speed_m_s, motion.acceleration_m_s2, True)
        if not taken:
            return "the controller did not take the motion"
        self._begun(operation)
        return ""

    def _start_path(self, motion: StartPath) -> str:
        """End our program and send it anew with the path in it, as ur_rtde does: tool and payload stay as they were."""
        from rtde_control import Path, PathEntry

        path = Path()
        for leg, blend_m in zip(motion.legs, motion.blends_m, strict=True):
            if isinstance(leg, StartJoints):
                kind, position = PathEntry.eMoveType.MoveJ, PathEntry.ePositionType.PositionJoints
                numbers = [*leg.q, leg.speed_rad_s, leg.acceleration_rad_s2, blend_m]
            else:
                kind, position = PathEntry.eMoveType.MoveL, PathEntry.ePositionType.PositionTcpPose
                numbers = [*leg.tcp_pose, leg.speed_m_s, leg.acceleration_m_s2, blend_m]
            path.addEntry(PathEntry(kind, position, numbers))
        taken = self._control.movePath(path, True)
        # The new program has no watchdog yet.
        self._watchdog_hz = 0.0
        if not taken or not self._set_watchdog(_MOVING_WATCHDOG_HZ):
            self._stop()
            return "the controller did not take the path"
        self._begun(_NO_OPERATION)
        return ""

    def _begun(self, operation: int) -> None:
        """A motion was commanded after the operation of that number."""
        self._operation, self._commanded_at = operation, time.monotonic()
        self._moving, self._stop_sent, self._ended_at = True, False, math.inf
        self._state.write(moving=True)

    def supervise(self) -> None:
        """Stop when asked to, or when nobody supervises the motion; and keep the controller's watchdog quiet."""
        if self._control is None:
            return
        now = time.monotonic()
        supervision = self._supervision.read()
        if int(supervision["stops"]) != self._stops:
            if self._stop():
                self._stops = int(supervision["stops"])
                self._state.write(stops=self._stops)
        elif self._moving and not self._stop_sent and now - float(supervision["kicked"]) > KICK_TIMEOUT_S:
            self._stop()
        if self._interrupted:
            return
        if not self._moving:
            self._set_watchdog(_IDLE_WATCHDOG_HZ)
        self._kick(now)

    def _set_watchdog(self, frequency_hz: float) -> bool:
        if frequency_hz != self._watchdog_hz:
            if not self._control.setWatchdog(frequency_hz):
                return False
            self._watchdog_hz = frequency_hz
        return True

    def _kick(self, now: float) -> None:
        if now >= self._kick_due:
            self._control.kickWatchdog()
            self._kick_due = now + _KICK_PERIOD_S

    def _stop(self) -> bool:
        """Brake; whether the controller was told, or has nothing to stop."""
        if not self._playing():
            # A paused program could be resumed: only the dashboard can end it.
            return bool(self._receive.getRuntimeState() == STOPPED)
        if self._moving and not self._stop_sent:
            operation = self._control.getAsyncOperationProgressEx().operationId()
            self._control.stopL(_STOP_DECELERATION_M_S2, True)
            self._operation, self._commanded_at = operation, time.monotonic()
            self._stop_sent = True
        return True

    def end(self) -> None:
        """Stop the arm and end our program."""
        if self._control is not None and not self._interrupted:
            self._stop()
            _wait_for(self._stands, _LAST_STOP_S)
            if self._playing():
                self._control.stopScript()

    def _stands(self) -> bool:
        self._judge_motion(self._receive.getActualQd())
        if self._moving:
            self._kick(time.monotonic())
        return not self._moving


def _wait_for(condition: Any, timeout_s: float) -> bool:
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(_POLL_S)
    return True


def _close(values: Any, wanted: Any) -> bool:
    return len(values) == len(wanted) and all(abs(a - b) < 1e-4 for a, b in zip(values, wanted, strict=True))
