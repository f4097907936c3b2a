"""A cell: its devices, its configuration, and supervised motions for whoever writes Python."""

from __future__ import annotations

import uuid
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config import find_backend
from robotcell.config.fingers import finger_problems
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault
from robotcell.io.lock_file import LockFile
from robotcell.motion.executor import Execution, Executor
from robotcell.motion.guard import Latch
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, JointMove, LinearMove, MotionPlan
from robotcell.motion.recorder import Recorder
from robotcell.motion.retreat import check_retreat, plan_recovery
from robotcell.perception.view import View, look

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from types import TracebackType

    import numpy.typing as npt

    from robotcell.config import CellConfig, Workspace
    from robotcell.interfaces import Arm, Camera, Clock, Devices, Gripper
    from robotcell.motion.guard import StopStore
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.motion.plan import Step
    from robotcell.perception.clearance_map import ClearanceMap


@dataclass(frozen=True)
class Cell:
    """The devices behind the interfaces. As a context manager it connects them all and closes them all.

    Attributes:
        config: of the cell.
        devices: arm, gripper, camera and clock.
        latch: remembers a safety stop until an operator recovers the cell.
        lock: that this process owns while the cell is open; None where nobody else can open it.
        lasting: whether the cell is still there when this process has ended; a simulated one is not.
        recorder: where the last second before a stop is written.
    """

    config: CellConfig
    devices: Devices
    latch: Latch = field(default_factory=Latch)
    lock: LockFile | None = None
    lasting: bool = False
    recorder: Recorder = field(default_factory=Recorder)

    @property
    def arm(self) -> Arm:
        """The arm itself, unsupervised."""
        return self.devices.arm

    @property
    def gripper(self) -> Gripper:
        """The gripper itself, unsupervised."""
        return self.devices.gripper

    @property
    def camera(self) -> Camera:
        """The camera itself."""
        return self.devices.camera

    @property
    def clock(self) -> Clock:
        """The cell's time."""
        return self.devices.clock

    @property
    def executor(self) -> Executor:
        """What runs checked plans on this cell."""
        return Executor(self.devices, self.config, self.latch, self.recorder)

    def look(self, workspace: Workspace | None = None) -> View:
        """Read the camera and see what is on the table; see `robotcell.perception.view.look`.

        Args:
            workspace: the map to build; that of the cell unless given.

        Raises:
            ConnectionLost, DeviceFault, CalibrationError: as the camera and the checks of its picture do.
        """
        return look(self.devices, self.config, workspace)

    def move(
        self,
        *,
        joints: npt.ArrayLike | None = None,
        T_base_tcp: npt.ArrayLike | None = None,
        speed: float | None = None,
        contact_force_n: float | None = None,
    ) -> Execution:
        """Move the arm, checked and supervised, and wait for its end.

        Give `joints` for a joint-space motion or `T_base_tcp` for a straight one.

        Args:
            joints: joint angles (6,) [rad].
            T_base_tcp: pose (4, 4) of the tcp.
            speed: of the leading joint [rad/s] or of the tcp [m/s]; that of the cell's file unless given.
            contact_force_n: ends a straight motion at that force [N], with `Ending.CONTACT`.

        Raises:
            ValueError: neither or both targets are given, or a force with joints.
            UnsafeMotion: the motion is not safe; nothing moved.
            GuardTripped, DeviceFault, ConnectionLost: it was stopped; recover the cell before the next one.
        """
        motion = self.config.motion
        step: Step
        if joints is not None and T_base_tcp is None and contact_force_n is None:
            q = np.asarray(joints, np.float64)
            step = JointMove("move", q, speed or motion.joint_speed_rad_s, motion.joint_acceleration_rad_s2)
        elif T_base_tcp is not None and joints is None:
            usual = motion.linear_speed_m_s if contact_force_n is None else motion.guarded_speed_m_s
            target, acceleration = np.asarray(T_base_tcp, np.float64), motion.linear_acceleration_m_s2
            step = LinearMove("move", target, speed or usual, acceleration, contact_force_n)
        else:
            raise ValueError("move needs either joints, or T_base_tcp with or without contact_force_n")
        return self.run([step], "move")

    def grip(self, width_m: float, force_n: float | None = None) -> Execution:
        """Move the fingers, supervised, and wait for their end.

        Args:
            width_m: distance between the finger tips.
            force_n: at most; that of the cell's file unless given.

        Raises:
            UnsafeMotion: width or force are outside the gripper's range; nothing moved.
            GuardTripped, DeviceFault, ConnectionLost: it was stopped; recover the cell before the next motion.
        """
        return self.run([Grip("grip", width_m, force_n or self.config.gripper.force_n)], "grip")

    def home(self, seen: ClearanceMap | None = None) -> Execution:
        """Straight up, open the fingers, and to the home pose, supervised.

        Args:
            seen: what may stand on the table, by the last look (`View.clearance`). Without it the arm goes up as high
                as it can first, and does not know what stands in its way.

        Raises:
            UnsafeMotion: the way is not safe; nothing moved.
            GuardTripped, DeviceFault, ConnectionLost: it was stopped; recover the cell before the next motion.
        """
        return self.executor.run(check_retreat(self.arm.state(), self.config, seen))

    def run(self, steps: Sequence[Step], label: str, seen: ClearanceMap | None = None) -> Execution:
        """Check steps as one plan from where the arm stands, run it supervised, and wait for its end.

        Args:
            steps: of the plan.
            label: what the plan is called in errors.
            seen: what may stand on the table, by the last look (`View.clearance`); without it the plan is checked
                against the furniture only.

        Raises:
            UnsafeMotion: a step is not safe; nothing moved.
            GuardTripped, DeviceFault, ConnectionLost: it was stopped; recover the cell before the next motion.
        """
        plan = MotionPlan(label, self.arm.state().q, tuple(steps))
        return self.executor.run(check_path(plan, self.config, seen))

    def recovery(self) -> CheckedPlan:
        """The motion that `recover` makes from where the arm stands now.

        Raises:
            UnsafeMotion: that way is not safe.
            ConnectionLost: the arm is not connected.
        """
        return check_path(plan_recovery(self.arm.state(), self.config), self.config)

    def leave_stops(self) -> None:
        """Leave a stop of gripper and arm; nothing moves. Only because an operator asked for it. The arm is connected.

        Raises:
            ConnectionLost, DeviceFault: a device cannot leave its stop; the message says what to do there.
        """
        self.gripper.recover()
        self.arm.recover()
        self.gripper.connect()

    def recover(self) -> None:
        """Leave the stops of the devices, go home slowly, and forget the stop; only because an operator asked for it.

        The arm must be connected. The way starts from measured joints, and the fingers stay as they are. The latch is
        cleared last: until the arm is home, the stop stands.

        Raises:
            ConnectionLost, DeviceFault: a device cannot leave its stop; the message says what to do there.
            UnsafeMotion: the way home is not safe; nothing moved, and the stop stands.
            GuardTripped: the arm was stopped on its way; the stop stands.
            StorageError: the arm is home, and the journal cannot be told.
        """
        self.leave_stops()
        plan = self.recovery()
        if plan.plan.steps:
            # The latch stands until the arm is home, and bars all others.
            Executor(self.devices, self.config, Latch()).run(plan)
        self.latch.clear()

    @contextmanager
    def opened_to_recover(self) -> Iterator[None]:
        """As a context manager: owns the cell and connects the arm, which is all that `recover` asks for.

        Raises:
            ConnectionLost, DeviceFault, StorageError: as when the cell is opened.
        """
        try:
            self._own()
            self.arm.connect()
            yield
        finally:
            self.close()

    def __enter__(self) -> Cell:
        """Own the cell, and connect every device, so that one attempt shows everything that is wrong.

        Raises:
            ConnectionLost, DeviceFault: the failure of the one device that failed, or all of them together
                (as DeviceFault if every device could be reached); or another process has the cell.
            StorageError: the lock or the latch cannot be read.
            ConfigError: a backend finds its own settings wrong, at the first device; or the mounted finger tips cannot
                reach what the cell's file asks of them.
        """
        failures: list[tuple[str, ConnectionLost | DeviceFault]] = []
        try:
            self._own()
            for name, device in (("arm", self.arm), ("gripper", self.gripper), ("camera", self.camera)):
                try:
                    device.connect()
                except (ConnectionLost, DeviceFault) as error:
                    failures.append((name, error))
        except BaseException:
            self.close()
            raise
        if not failures:
            self._check_fingers()
        if failures:
            self.close()
            if len(failures) == 1:
                raise failures[0][1]
            kind = ConnectionLost if any(isinstance(e, ConnectionLost) for _, e in failures) else DeviceFault
            raise kind("\n  ".join(["the cell cannot be opened:", *(f"{name}: {error}" for name, error in failures)]))
        return self

    def _check_fingers(self) -> None:
        try:
            problems = finger_problems(self.config, self.gripper.range())
        except BaseException:
            self.close()
            raise
        if problems:
            self.close()
            raise ConfigError("\n  ".join(["the cell cannot be opened:", *problems]))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close every device, the arm first, whatever interrupts it; then let others have the cell. Idempotent."""
        with ExitStack() as last_to_first:
            if self.lock is not None:
                last_to_first.callback(self.lock.release, forget=not self.lasting)
            for device in (self.camera, self.gripper, self.arm):
                last_to_first.callback(device.close)

    def _own(self) -> None:
        """Take the lock, and over the stop that an earlier process left.

        Raises:
            DeviceFault: another process has the cell.
            StorageError, ConfigError: the lock or the latch cannot be read.
        """
        if self.lock is not None:
            owner = self.lock.acquire()
            if owner is not None:
                raise DeviceFault(
                    f"the cell ({self.lock.name}) is in use by {owner}: wait until that has ended, or end it by "
                    "robotcell stop"
                )
        self.latch.load()


def open_cell(config: CellConfig, store: StopStore | None = None) -> Cell:
    """The cell of a configuration, its devices not yet connected: use it in a `with` statement.

    Args:
        config: of the cell.
        store: keeps a stop for the next process; without one a stop ends with this one. `robotcell.open_cell` gives the
            journal's.

    Raises:
        ConfigError: its backend is not installed.
    """
    backend = find_backend(config.backend.name)
    name = backend.cell_name(config)
    lock = LockFile(name or f"process-{uuid.uuid4().hex}")
    return Cell(config, backend.open(config), Latch(store if name else None), lock, lasting=name is not None)
