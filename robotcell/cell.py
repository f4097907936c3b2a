"""A cell: its devices, its configuration, and supervised motions for whoever writes Python."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config import find_backend
from robotcell.config.fingers import finger_problems
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault
from robotcell.motion.executor import Execution, Executor
from robotcell.motion.guard import Latch
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, JointMove, LinearMove, MotionPlan
from robotcell.motion.recorder import Recorder
from robotcell.motion.retreat import plan_retreat
from robotcell.perception.view import View, look

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

    import numpy.typing as npt

    from robotcell.config import CellConfig, Workspace
    from robotcell.interfaces import Arm, Camera, Clock, Devices, Gripper
    from robotcell.motion.plan import Step


@dataclass(frozen=True)
class Cell:
    """The devices behind the interfaces. As a context manager it connects them all and closes them all.

    Attributes:
        config: of the cell.
        devices: arm, gripper, camera and clock.
        latch: remembers a safety stop until an operator recovers the cell.
        recorder: where the last second before a stop is written.
    """

    config: CellConfig
    devices: Devices
    latch: Latch = field(default_factory=Latch)
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

    def home(self) -> Execution:
        """Straight up, open the fingers, and to the home pose, supervised.

        Raises:
            UnsafeMotion: the way is not safe; nothing moved.
            GuardTripped, DeviceFault, ConnectionLost: it was stopped; recover the cell before the next motion.
        """
        return self.executor.run(check_path(plan_retreat(self.arm.state(), self.config), self.config))

    def run(self, steps: Sequence[Step], label: str) -> Execution:
        """Check steps as one plan from where the arm stands, run it supervised, and wait for its end.

        Args:
            steps: of the plan.
            label: what the plan is called in errors.

        Raises:
            UnsafeMotion: a step is not safe; nothing moved.
            GuardTripped, DeviceFault, ConnectionLost: it was stopped; recover the cell before the next motion.
        """
        plan = MotionPlan(label, self.arm.state().q, tuple(steps))
        return self.executor.run(check_path(plan, self.config))

    def recover(self) -> None:
        """Leave a stop of gripper and arm, because an operator asked for it. The arm must be connected.

        Raises:
            ConnectionLost, DeviceFault: a device cannot leave its stop; the message says what to do there.
        """
        self.gripper.recover()
        self.arm.recover()
        self.latch.clear()

    def __enter__(self) -> Cell:
        """Connect every device, so that one attempt shows everything that is wrong.

        Raises:
            ConnectionLost, DeviceFault: the failure of the one device that failed, or all of them together
                (as DeviceFault if every device could be reached).
            ConfigError: a backend finds its own settings wrong, at the first device; or the mounted finger tips cannot
                reach what the cell's file asks of them.
        """
        failures: list[tuple[str, ConnectionLost | DeviceFault]] = []
        try:
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
        """Close every device; idempotent."""
        self.camera.close()
        self.gripper.close()
        self.arm.close()


def open_cell(config: CellConfig) -> Cell:
    """The cell of a configuration, its devices not yet connected: use it in a `with` statement.

    Raises:
        ConfigError: its backend is not installed.
    """
    return Cell(config, find_backend(config.backend.name).open(config))
