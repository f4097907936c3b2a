"""What the arm and the gripper will do, step by step. A plan is data: `path_check` says whether it is safe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array


@dataclass(frozen=True)
class JointMove:
    """A joint-space motion to q (6,) [rad]; `load_m` is how far a held object reaches below the tcp."""

    label: str
    q: Array
    speed_rad_s: float
    acceleration_rad_s2: float
    load_m: float = 0.0


@dataclass(frozen=True)
class LinearMove:
    """A straight motion of the tcp to `T_base_tcp`.

    With `contact_force_n` the motion is guarded: that force ends the plan with `Ending.CONTACT`. Fingers and load may
    touch what reaches up to `touch_m` above the table [m] meanwhile; with None nothing is to be touched.
    """

    label: str
    T_base_tcp: Array
    speed_m_s: float
    acceleration_m_s2: float
    contact_force_n: float | None = None
    load_m: float = 0.0
    touch_m: float | None = None


@dataclass(frozen=True)
class Grip:
    """A motion of the fingers, waited for.

    Where the arm feels more than `contact_force_n` meanwhile, the fingers go back to where they were, and the plan ends
    with `Ending.CONTACT`.
    """

    label: str
    width_m: float
    force_n: float
    contact_force_n: float | None = None


@dataclass(frozen=True)
class CheckHold:
    """Ends the plan with `Ending.EMPTY` unless the fingers hold something at least this wide."""

    label: str
    min_width_m: float


Step: TypeAlias = JointMove | LinearMove | Grip | CheckHold


@dataclass(frozen=True)
class MotionPlan:
    """Steps that start from the joint angles `q_start` (6,) [rad]."""

    label: str
    q_start: Array
    steps: tuple[Step, ...]


def joint_move(label: str, q: Array, config: CellConfig, load_m: float = 0.0) -> JointMove:
    """A joint-space motion at the speed of the cell's file; see `JointMove`."""
    return JointMove(label, q, config.motion.joint_speed_rad_s, config.motion.joint_acceleration_rad_s2, load_m)


def linear_move(
    label: str, T_base_tcp: Array, config: CellConfig, load_m: float = 0.0, touch_m: float | None = None
) -> LinearMove:
    """A straight motion at the speed of the cell's file; see `LinearMove`."""
    motion = config.motion
    speed, acceleration = motion.linear_speed_m_s, motion.linear_acceleration_m_s2
    return LinearMove(label, T_base_tcp, speed, acceleration, load_m=load_m, touch_m=touch_m)


def guarded_move(label: str, T_base_tcp: Array, config: CellConfig, touch_m: float) -> LinearMove:
    """A straight motion, guarded by the speed and the contact force of the cell's file; see `LinearMove`."""
    motion = config.motion
    speed, acceleration = motion.guarded_speed_m_s, motion.linear_acceleration_m_s2
    return LinearMove(label, T_base_tcp, speed, acceleration, motion.contact_force_n, touch_m=touch_m)


def home_move(config: CellConfig, load_m: float = 0.0) -> JointMove:
    """The motion to the home pose; see `JointMove`."""
    return joint_move("home", np.array(config.motion.home_q), config, load_m)
