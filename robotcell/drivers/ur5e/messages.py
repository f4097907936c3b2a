"""What passes between the driver of the UR5e and its child process: requests, answers, two records in shared memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from robotcell.io.shared_record import record_size

# Written by the child with every data package. `t`: time.monotonic() [s] of the measurement. `ready`: our program runs
# on the controller and was never interrupted. `stops`: how many stops were acted upon. `stopped_at`: time.monotonic()
# [s] at which a protective stop was first seen, 0 without one.
STATE = np.dtype(
    [
        ("t", "f8"),
        ("q", "f8", 6),
        ("qd", "f8", 6),
        ("tcp_pose", "f8", 6),
        ("tcp_force", "f8", 6),
        ("robot_mode", "i4"),
        ("safety_mode", "i4"),
        ("runtime_state", "i4"),
        ("speed_fraction", "f8"),
        ("ready", "u1"),
        ("moving", "u1"),
        ("stops", "u8"),
        ("stopped_at", "f8"),
    ]
)
# Written by the driver. `kicked`: time.monotonic() [s] of the last sign of life; `stops`: how many were asked for.
SUPERVISION = np.dtype([("kicked", "f8"), ("stops", "u8")])
# The second record stands behind the first.
SUPERVISION_OFFSET = record_size(STATE)


@dataclass(frozen=True)
class Setup:
    """The first message to a child: what to connect to, and what to set there.

    Attributes:
        host: address of the controller.
        control: whether to start our program, or only to watch.
        tcp_offset: pose (6,) [m, rad] of the tool centre point on the flange.
        payload_kg: mass of the tool.
        payload_cog: (3,) [m] its centre of gravity, flange axes.
    """

    host: str
    control: bool
    tcp_offset: tuple[float, ...]
    payload_kg: float
    payload_cog: tuple[float, ...]


@dataclass(frozen=True)
class StartJoints:
    """Start a joint-space motion to q (6,) [rad]."""

    q: tuple[float, ...]
    speed_rad_s: float
    acceleration_rad_s2: float


@dataclass(frozen=True)
class StartLinear:
    """Start a straight motion of the tcp to a pose (6,) [m, rad]."""

    tcp_pose: tuple[float, ...]
    speed_m_s: float
    acceleration_m_s2: float


@dataclass(frozen=True)
class StartPath:
    """Start one motion along legs whose corners are rounded, each within the radius that goes with it [m]."""

    legs: tuple[StartJoints | StartLinear, ...]
    blends_m: tuple[float, ...]


@dataclass(frozen=True)
class Close:
    """Stop the arm, end our program, and end."""


@dataclass(frozen=True)
class Answer:
    """What came of a message; `refusal` is "" if it was done."""

    refusal: str = ""


Request: TypeAlias = Setup | StartJoints | StartLinear | StartPath | Close
