"""What an arm, a gripper, a camera and a clock must do, and what they report.

Every backend (hardware, twin, somebody else's) implements these Protocols; tests/contract states them as tests.
`connect()` does the work, `close()` is idempotent and safe on a half-open device, and each device is a context
manager that does both. Metres, radians, seconds, newtons.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import TracebackType

    from typing_extensions import Self

    from robotcell.findings import Finding

Array: TypeAlias = npt.NDArray[np.float64]

# A motion that is not kicked for so long [s] stops, on every backend. Chosen: 25 periods of the executor, so that a
# pause of the interpreter costs no motion, and 5 cm of a straight motion at 0.25 m/s.
KICK_TIMEOUT_S = 0.2


class ArmMode(enum.Enum):
    """What the controller lets the arm do."""

    READY = "ready"
    NOT_READY = "not ready"  # powered off, booting, brakes locked, local control
    PROTECTIVE_STOP = "protective stop"
    EMERGENCY_STOP = "emergency stop"


@dataclass(frozen=True)
class ArmState:
    """One measurement of the arm.

    Attributes:
        t: time of the measurement on the cell's clock [s].
        q: joint angles (6,) [rad].
        qd: joint speeds (6,) [rad/s].
        T_base_tcp: pose of the tool centre point (4, 4); its origin is between the closed finger tips.
        wrench: force (3) [N] and torque (3) [N m] that the surroundings exert on the tool, base axes, at the tcp.
        mode: what the controller lets the arm do.
    """

    t: float
    q: Array
    qd: Array
    T_base_tcp: Array
    wrench: Array
    mode: ArmMode


@dataclass(frozen=True)
class GripperState:
    """One measurement of the gripper.

    Attributes:
        t: time of the measurement on the cell's clock [s].
        width_m: distance between the finger tips.
        busy: the fingers are moving.
        grip_detected: the fingers were stopped by something before they reached the commanded width.
    """

    t: float
    width_m: float
    busy: bool
    grip_detected: bool


@dataclass(frozen=True)
class GripperRange:
    """What a gripper can do with the finger tips that are mounted on it.

    Attributes:
        fingertip_offset_m: how far each tip reaches inwards from the bare finger, outwards where negative.
        min_width_m: between the tips of the fingers when they are closed as far as they go.
        max_width_m: the same when they are wide open.
        min_force_n: of a grip.
        max_force_n: of a grip.
    """

    fingertip_offset_m: float
    min_width_m: float
    max_width_m: float
    min_force_n: float
    max_force_n: float


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole model of an undistorted image: u = fx x / z + cx, v = fy y / z + cy [px]."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class RgbdFrame:
    """A colour image and the depth registered to it.

    Attributes:
        t: time of capture on the cell's clock [s].
        number: the device's frame number, growing by at least one from frame to frame.
        color: (H, W, 3) uint8 RGB.
        depth_m: (H, W) float32 [m] along the optical axis, 0 = no return.
        intrinsics: of both images, in the colour optical frame.
        serial: of the device; None where it is not known.
    """

    t: float
    number: int
    color: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]
    intrinsics: Intrinsics
    serial: str | None = None


class Clock(Protocol):
    """The only source of time. On hardware the wall clock; in the twin `sleep` advances the physics."""

    def now(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep(self, dt: float) -> None:
        """Let `dt` >= 0 seconds pass."""
        ...


class Device(Protocol):
    """What the three devices share."""

    def connect(self) -> None:
        """Open the device. Does nothing when it is open.

        Raises:
            ConnectionLost: it cannot be reached.
            DeviceFault: it is there and refuses to work.
        """
        ...

    def close(self) -> None:
        """Release the device and stop what it does. Idempotent, safe at any time, never raises."""
        ...

    def __enter__(self) -> Self:
        """Connect. A class that names its Protocol as its base inherits this."""
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class JointWaypoint:
    """One leg of a path: a joint-space motion to q (6,) [rad], the leading joint at the given speed and acceleration.

    Within `blend_m` of its end the tcp may leave it for the next leg; 0: it comes to rest there.
    """

    q: Array
    speed_rad_s: float
    acceleration_rad_s2: float
    blend_m: float = 0.0


@dataclass(frozen=True)
class LinearWaypoint:
    """One leg of a path: a straight motion of the tcp to `T_base_tcp` (4, 4), rotation interpolated.

    Within `blend_m` of its end the tcp may leave it for the next leg; 0: it comes to rest there.
    """

    T_base_tcp: Array
    speed_m_s: float
    acceleration_m_s2: float
    blend_m: float = 0.0


Waypoint: TypeAlias = JointWaypoint | LinearWaypoint


class Arm(Device, Protocol):
    """A six-joint arm. Motions return at once; the caller supervises them with `moving`, `state`, `kick` and `stop`.

    A motion that is not kicked for `KICK_TIMEOUT_S` stops, whether or not it was ever kicked.

    Every method raises ConnectionLost when the arm is not connected (or no longer is), and those that move it
    raise DeviceFault when its mode is not READY and UnsafeMotion when the device would refuse the argument. A new
    motion may start only when the last one has ended (UnsafeMotion otherwise).
    """

    @property
    def moving(self) -> bool:
        """Whether a commanded motion is under way. False once it has ended, was stopped or was cut by a stop."""
        ...

    def state(self) -> ArmState:
        """The newest measurement."""
        ...

    def report(self) -> tuple[Finding, ...]:
        """What the arm says of its own settings that a motion depends on; nothing where it cannot be asked.

        Payload and tool centre point as they are read back, remote control, speed slider. Takes some tens of
        milliseconds, and is asked before a job.
        """
        ...

    def start_joints(self, q: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint-space motion to q (6,) [rad], the leading joint at the given speed."""
        ...

    def start_linear(self, T_base_tcp: Array, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Start a straight motion of the tcp to `T_base_tcp`, rotation interpolated.

        Only the ranges of the arguments are checked here: a line that the arm cannot follow ends in a stop that must be
        recovered. `robotcell.motion.path_check` finds such lines before anything moves.
        """
        ...

    def start_path(self, waypoints: Sequence[Waypoint]) -> None:
        """Start one motion along several legs, with rounded corners (`robotcell.geometry.rounded_path`).

        What `start_joints` and `start_linear` say of their arguments holds for each leg. The last waypoint has no
        `blend_m`: the motion ends there, at rest.
        """
        ...

    def stop(self) -> None:
        """Bring the arm to a standstill as fast as the controller's normal stop does. Returns at once."""
        ...

    def kick(self) -> None:
        """Say that the motion is supervised. Cheap; called in every supervision period."""
        ...

    def recover(self) -> None:
        """Leave a protective stop. Only ever called because an operator asked for it.

        Raises:
            DeviceFault: the stop cannot be left from here; the message says what to do at the pendant.
        """
        ...


class Gripper(Device, Protocol):
    """A two-finger gripper. Commands are idempotent and return at once; raises as `Arm` does."""

    def state(self) -> GripperState:
        """The newest measurement."""
        ...

    def range(self) -> GripperRange:
        """What it can reach, with the finger tips that it has."""
        ...

    def start_width(self, width_m: float, force_n: float) -> None:
        """Start moving the finger tips to `width_m` apart, pressing with at most `force_n`.

        Raises:
            UnsafeMotion: width or force are outside the device's range.
        """
        ...

    def stop(self) -> None:
        """Stop the fingers where they are."""
        ...

    def recover(self) -> None:
        """Leave a fault that holds the fingers, only because an operator asked for it. Works without a connection too.

        Raises:
            ConnectionLost: the gripper cannot be reached.
            DeviceFault: the cause is still there.
        """
        ...


class Camera(Device, Protocol):
    """An RGB-D camera."""

    def read(self) -> RgbdFrame:
        """A frame that was captured after this call.

        Raises:
            ConnectionLost: no frame came.
            DeviceFault: the device delivers stale or unusable frames.
        """
        ...

    def poll(self, since: float) -> Callable[[], RgbdFrame] | None:
        """A frame that was captured at `since` [s] on the cell's clock or later; None until there is one.

        Returns at once, so that it can be called while the arm is supervised. What it returns makes the images; it
        takes its time, touches no device, and may be called in another thread before the camera is used again.

        Raises:
            ConnectionLost: the camera is not connected, or no frame comes.
            DeviceFault: as `read`; from what is returned as well.
        """
        ...


@dataclass(frozen=True)
class Devices:
    """What a backend opens: the devices of one cell and its clock, not yet connected."""

    arm: Arm
    gripper: Gripper
    camera: Camera
    clock: Clock
