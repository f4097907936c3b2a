"""The UR5e over ur_rtde 1.6, which runs in a child process of its own: `child`.

This side judges: it inspects the controller before ur_rtde is let near it, refuses what the controller could not do,
takes a state that is too old, a child that died or a command that is not answered for a lost connection, and holds the
second line of `stop`, the dashboard. After a loss `connect` starts afresh.

Nothing resumes by itself: a program that was interrupted is ended, and only `recover` starts the next one.
"""

from __future__ import annotations

import importlib.util
import logging
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from robotcell.drivers.unconfirmed import warn_unconfirmed
from robotcell.drivers.ur5e.child_process import ChildProcess
from robotcell.drivers.ur5e.controller import arm_mode, inspect, obstacles, program_held, slow_slider, why_not_ready
from robotcell.drivers.ur5e.controller_findings import TCP_OFFSET, controller_findings, tool_findings
from robotcell.drivers.ur5e.dashboard import Dashboard
from robotcell.drivers.ur5e.messages import Setup, StartJoints, StartLinear, StartPath
from robotcell.errors import CellError, ConfigError, ConnectionLost, DeviceFault, UnsafeMotion
from robotcell.geometry.controller_ranges import check_path_motion
from robotcell.geometry.transforms import make_transform, matrix_to_rotvec, rotvec_to_matrix
from robotcell.interfaces import Arm, ArmMode, ArmState, JointWaypoint, LinearWaypoint

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from robotcell.drivers.ur5e.controller import Controller
    from robotcell.findings import Finding
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Clock, Waypoint

_LOG = logging.getLogger(__name__)

# A state older than this means that the controller is lost.
LOST_S = 0.5
# How long a stop may take on its way through ur_rtde before the dashboard is told.
_STOP_ACTS_S = 0.035
# Universal Robots: a protective stop cannot be left before 5 s have passed.
_PROTECTIVE_WAIT_S = 5.2
_RELEASE_S = 3.0
# A program of ours that lost its driver is ended by the watchdog after 0.125 s.
_PROGRAM_ENDS_S = 1.0
_POLL_S = 0.05


class UR5eOptions(BaseModel):
    """`backend.options.arm` of a hardware cell.

    Attributes:
        host: address of the controller.
        payload_kg: mass of gripper and quick changer. The RG2 weighs 0.78 kg (datasheet).
        payload_cog: its centre of gravity [m], axes of the flange. Assumed for the RG2; UR's payload estimation at the
            pendant measures it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    host: Annotated[str, Field(min_length=1)]
    payload_kg: Annotated[float, Field(ge=0, le=5)] = 0.78
    payload_cog: tuple[float, float, float] = (0.0, 0.0, 0.064)


class UR5e(Arm):
    """The `Arm` behind a UR controller."""

    def __init__(self, options: UR5eOptions, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._dashboard = Dashboard(options.host)
        self._child: ChildProcess | None = None
        self._lost = ""

    def connect(self) -> None:
        """Check the controller, start our program on it and set the tool. Does nothing when connected.

        An arm in a protective stop, or with a program on it, is connected as it stands: its mode says so, nothing moves
        it, and `recover` makes it ready.

        Raises:
            ConnectionLost: the controller cannot be reached, or does not answer.
            DeviceFault: it must be changed at the pendant first; the message lists everything, with the cures.
            ConfigError: ur_rtde is not installed.
        """
        if self._child is not None:
            with suppress(ConnectionLost):
                self._record()
                return
        self.close()
        if importlib.util.find_spec("rtde_control") is None:
            raise ConfigError("ur_rtde is not installed: pip install 'robotcell[hardware]'", device="arm")
        warn_unconfirmed("UR5e")
        try:
            controller, held = self._inspect_idle()
            self._check(controller)
            if controller.protective_stop:
                held = "it is in a protective stop: look at the cell, clear the contact, then run robotcell recover"
            if held:
                _LOG.warning("the arm at %s is not ready: %s", self._options.host, held)
            self._dashboard.connect()
            self._start_child(control=not held)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the arm, end our program and let the controller go. Idempotent."""
        if self._child is not None:
            self._child.close()
        self._child = None
        self._lost = ""
        self._dashboard.close()

    @property
    def pid(self) -> int | None:
        """The process in which ur_rtde runs; None without a connection."""
        return self._child.pid if self._child else None

    @property
    def moving(self) -> bool:
        """Whether a motion, or the braking that ends it, is under way."""
        return bool(self._record()["moving"])

    def state(self) -> ArmState:
        """The newest data package; at most 8 ms older than the controller's own."""
        record = self._record()
        return ArmState(
            t=self._clock.now() - (time.monotonic() - float(record["t"])),
            q=record["q"],
            qd=record["qd"],
            T_base_tcp=make_transform(rotvec_to_matrix(record["tcp_pose"][3:]), record["tcp_pose"][:3]),
            wrench=record["tcp_force"],
            mode=_mode(record),
        )

    def report(self) -> tuple[Finding, ...]:
        """What the controller says of itself and of the tool that was set at connect; see `Arm`."""
        self._record()
        controller = inspect(self._options.host)
        tool = tool_findings(controller, self._options.payload_kg, self._options.payload_cog, changed=True)
        return (*controller_findings(controller), *tool)

    def start_joints(self, q: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint-space motion; see `Arm`.

        Raises:
            UnsafeMotion: q is outside the joint limits or not six finite numbers, speed or acceleration are outside
                the controller's range, or the arm is moving.
            DeviceFault: the arm is stopped, or its speed slider is at zero.
        """
        self.start_path((JointWaypoint(q, speed_rad_s, acceleration_rad_s2),))

    def start_linear(self, T_base_tcp: Array, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Start a straight motion of the tcp; see `Arm`.

        Where the controller cannot follow the line it ends our program, or makes a protective stop.

        Raises:
            UnsafeMotion: the pose is no rigid transform, speed or acceleration are outside the controller's range, or
                the arm is moving.
            DeviceFault: the arm is stopped, or its speed slider is at zero.
        """
        self.start_path((LinearWaypoint(T_base_tcp, speed_m_s, acceleration_m_s2),))

    def start_path(self, waypoints: Sequence[Waypoint]) -> None:
        """Start a motion along several legs; see `Arm`. A path of one leg is the motion of that leg.

        The controller rounds the corners by its own rule, within the radii. ur_rtde has no command for a path: it ends
        our program and sends it anew with the path in it. Meanwhile the arm stands.

        Raises:
            UnsafeMotion: a leg is outside the ranges, a blend radius too, or the arm is moving.
            DeviceFault: the arm is stopped, or its speed slider is at zero.
        """
        self._need_ready()
        legs = check_path_motion(waypoints)
        messages = tuple(_leg(leg) for leg in legs)
        self._start(messages[0] if len(legs) == 1 else StartPath(messages, tuple(float(leg.blend_m) for leg in legs)))

    def stop(self) -> None:
        """Brake the tool at 10 m/s^2.

        Where the controller does not confirm this at once, its dashboard is told to end our program, which brakes too:
        the arm must then be recovered.
        """
        record = self._record()
        if not record["ready"]:
            # Our program was interrupted; nothing shall resume it.
            self._dashboard.send("stop")
            return
        if not record["moving"]:
            return
        wanted = self._need_child().request_stop()
        deadline = time.monotonic() + _STOP_ACTS_S
        while int(self._record()["stops"]) != wanted:
            if time.monotonic() > deadline:
                self._dashboard.send("stop")
                return
            self._clock.sleep(0.001)

    def kick(self) -> None:
        """Tell the child that the motion is supervised; it stops one that is not."""
        self._record()
        self._need_child().kick()

    def recover(self) -> None:
        """Leave a protective stop or an ended program, and start our program anew. Does nothing when ready.

        Waits until 5 s have passed since the stop. Whatever program was held by the stop is ended before the stop is
        left: nothing resumes.

        Raises:
            DeviceFault: the stop cannot be left from here; the message says what to do at the pendant.
        """
        record = self._record()
        mode = _mode(record)
        if mode is ArmMode.READY:
            return
        self._check(inspect(self._options.host))
        self._dashboard.ask("stop")
        if mode is ArmMode.PROTECTIVE_STOP:
            self._leave_protective_stop(float(record["stopped_at"]))
        self._need_child().close()
        self._child = None
        try:
            controller, held = self._inspect_idle()
            self._check(controller)
            if held or controller.protective_stop:
                raise DeviceFault(
                    f"the arm at {self._options.host}: {held or 'the protective stop came back'}", device="arm"
                )
            self._start_child(control=True)
        except BaseException:
            self.close()
            raise

    def _leave_protective_stop(self, stopped_at: float) -> None:
        self._clock.sleep(max(0.0, stopped_at + _PROTECTIVE_WAIT_S - time.monotonic()))
        self._dashboard.ask("close safety popup")
        answer = self._dashboard.ask("unlock protective stop")
        if "releasing" not in answer:
            raise DeviceFault(
                f"the protective stop cannot be left from here: {answer}; clear it at the pendant", device="arm"
            )
        deadline = time.monotonic() + _RELEASE_S
        while _mode(self._record()) is ArmMode.PROTECTIVE_STOP:
            if time.monotonic() > deadline:
                raise DeviceFault(
                    "the protective stop came back at once: free the arm with freedrive at the pendant, then run "
                    "robotcell recover",
                    device="arm",
                )
            self._clock.sleep(_POLL_S)

    def _inspect_idle(self) -> tuple[Controller, str]:
        """The controller, once no program runs on it; and the words for one that still does, "" for none."""
        deadline = time.monotonic() + _PROGRAM_ENDS_S
        while True:
            controller = inspect(self._options.host)
            held = program_held(controller.runtime_state)
            # In a protective stop a program stays paused, until the recovery ends it.
            if not held or controller.protective_stop or time.monotonic() > deadline:
                return controller, held
            self._clock.sleep(_POLL_S)

    def _check(self, controller: Controller) -> None:
        found = obstacles(controller)
        if found:
            raise DeviceFault("\n  ".join([f"the arm at {self._options.host} cannot be driven:", *found]), device="arm")

    def _start_child(self, *, control: bool) -> None:
        options = self._options
        setup = Setup(
            host=options.host,
            control=control,
            tcp_offset=TCP_OFFSET,
            payload_kg=options.payload_kg,
            payload_cog=options.payload_cog,
        )
        self._child = ChildProcess.start()
        refusal = self._child.ask(setup).refusal
        if refusal:
            raise DeviceFault(f"the arm at {options.host}: {refusal}", device="arm")

    def _start(self, motion: StartJoints | StartLinear | StartPath) -> None:
        child = self._need_child()
        child.kick()
        try:
            refusal = child.ask(motion).refusal
        except ConnectionLost as error:
            raise self._lose(str(error)) from None
        if refusal:
            record = self._record()
            raise DeviceFault(
                f"{refusal}; {why_not_ready(int(record['robot_mode']), int(record['safety_mode']))}", device="arm"
            )

    def _need_ready(self) -> None:
        record = self._record()
        if _mode(record) is not ArmMode.READY:
            raise DeviceFault(why_not_ready(int(record["robot_mode"]), int(record["safety_mode"])), device="arm")
        if record["moving"]:
            raise UnsafeMotion("the arm is still moving: wait until the motion has ended, or stop it", device="arm")
        slow = slow_slider(float(record["speed_fraction"]))
        if slow:
            raise DeviceFault(f"the arm would not move: {slow}", device="arm")

    def _need_child(self) -> ChildProcess:
        if self._child is None:
            if self._lost:
                raise ConnectionLost(f"the arm was lost ({self._lost}): connect it again", device="arm")
            raise ConnectionLost("the arm is not connected: connect it first", device="arm")
        return self._child

    def _record(self) -> np.void:
        """The newest record of the child.

        Raises:
            ConnectionLost: there is no child, it died, or its record is old.
        """
        child = self._need_child()
        try:
            record = child.state()
        except ConnectionLost as error:
            raise self._lose(str(error)) from None
        age = time.monotonic() - float(record["t"])
        if age > LOST_S:
            raise self._lose(f"the controller has sent nothing for {age:.1f} s")
        return record

    def _lose(self, reason: str) -> ConnectionLost:
        """Give the connection up. Without the child's kicks the controller stops the arm; the dashboard is told too."""
        if self._child is not None:
            self._child.kill()
        self._child = None
        with suppress(CellError):
            self._dashboard.send("stop")
        self._dashboard.close()
        self._lost = f"{reason}; check the controller and the cable, see robotcell doctor"
        return ConnectionLost(
            f"the arm at {self._options.host} is lost: {self._lost}, then connect again", device="arm"
        )


def _leg(waypoint: Waypoint) -> StartJoints | StartLinear:
    if isinstance(waypoint, JointWaypoint):
        return StartJoints(tuple(waypoint.q.tolist()), float(waypoint.speed_rad_s), float(waypoint.acceleration_rad_s2))
    T = waypoint.T_base_tcp
    pose = (*T[:3, 3].tolist(), *matrix_to_rotvec(T[:3, :3]).tolist())
    return StartLinear(pose, float(waypoint.speed_m_s), float(waypoint.acceleration_m_s2))


def _mode(record: np.void) -> ArmMode:
    return arm_mode(int(record["robot_mode"]), int(record["safety_mode"]), ready=bool(record["ready"]))
