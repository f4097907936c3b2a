"""What the arm and the gripper will do, step by step. A plan is data: `path_check` says whether it is safe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from robotcell.errors import UnsafeMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array


# In the middle of its corner the path then passes its target at 10 to 15 mm.
_BLEND_M = 0.05
# A leg that ends at rest keeps a little of its own.
_BLEND_SHARE = 0.9


@dataclass(frozen=True)
class JointMove:
    """A joint-space motion to q (6,) [rad].

    Attributes:
        label: of the step.
        q: target.
        speed_rad_s: of the leading joint.
        acceleration_rad_s2: of the leading joint.
        load_m: how far a held object reaches below the tcp.
        blend_m: within which distance of its target the path may be rounded into that of the next motion; 0: the arm
            comes to rest at the target. Between the two stands at most a check for a held object.
    """

    label: str
    q: Array
    speed_rad_s: float
    acceleration_rad_s2: float
    load_m: float = 0.0
    blend_m: float = 0.0


@dataclass(frozen=True)
class LinearMove:
    """A straight motion of the tcp to `T_base_tcp`; `load_m` and `blend_m` as in `JointMove`.

    With `contact_force_n` the motion is guarded: that force ends the plan with `Ending.CONTACT`. A guarded motion
    begins and ends at rest. Fingers and load may touch what reaches up to `touch_m` above the table [m] meanwhile; with
    None nothing is to be touched.
    """

    label: str
    T_base_tcp: Array
    speed_m_s: float
    acceleration_m_s2: float
    contact_force_n: float | None = None
    load_m: float = 0.0
    touch_m: float | None = None
    blend_m: float = 0.0


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
class Shape:
    """A motion of the fingers in free air, beside which the plan goes on.

    Attributes:
        label: of the step.
        width_m: where the fingers are sent.
        force_n: at most.
        clear_m: the plan goes on as soon as their opening has changed by this; 0: at once. The next guarded motion,
            grip or check waits until they are there.
    """

    label: str
    width_m: float
    force_n: float
    clear_m: float = 0.0


@dataclass(frozen=True)
class CheckHold:
    """Ends the plan with `Ending.EMPTY` unless the fingers hold something at least this wide.

    Between two motions that are blended it is made as the arm passes the corner.
    """

    label: str
    min_width_m: float


Step: TypeAlias = JointMove | LinearMove | Grip | Shape | CheckHold


@dataclass(frozen=True)
class MotionPlan:
    """Steps that start from the joint angles `q_start` (6,) [rad]."""

    label: str
    q_start: Array
    steps: tuple[Step, ...]


def is_guarded(step: Step) -> bool:
    """Whether a step is a motion that a contact ends."""
    return isinstance(step, LinearMove) and step.contact_force_n is not None


def blended(steps: Sequence[Step]) -> tuple[tuple[int, ...], ...]:
    """The numbers of the steps that are carried out as one.

    Motions up to the one that comes to rest, with the checks between them; every other step for itself.

    Raises:
        UnsafeMotion: a motion is to be blended with what is no free motion.
    """
    groups: list[tuple[int, ...]] = []
    group: list[int] = []
    for i, step in enumerate(steps):
        free = isinstance(step, JointMove | LinearMove) and not is_guarded(step)
        if group and not (free or isinstance(step, CheckHold)):
            raise UnsafeMotion(f"step {steps[group[0]].label!r} cannot be blended with {step.label!r}: no free motion")
        group.append(i)
        blends = isinstance(step, JointMove | LinearMove) and step.blend_m > 0
        if blends and not free:
            raise UnsafeMotion(f"step {step.label!r} is guarded and ends at rest: it cannot be blended")
        if not blends and (free or len(group) == 1):
            groups.append(tuple(group))
            group = []
    if group:
        raise UnsafeMotion(f"step {steps[group[0]].label!r} cannot be blended: no motion follows")
    return tuple(groups)


def one_by_one(plan: MotionPlan) -> MotionPlan:
    """The plan with a standstill at every target, and with fingers that are waited for: it takes the least room."""
    steps: list[Step] = []
    for step in plan.steps:
        if isinstance(step, JointMove | LinearMove):
            steps.append(replace(step, blend_m=0.0))
        elif isinstance(step, Shape):
            steps.append(Grip(step.label, step.width_m, step.force_n))
        else:
            steps.append(step)
    return replace(plan, steps=tuple(steps))


def guarded_descents(plan: MotionPlan, config: CellConfig) -> MotionPlan:
    """The plan with descents that are guarded, and slow, from their beginning; they may touch what they pass beside."""
    steps = tuple(
        guarded_move(step.label, step.T_base_tcp, config, step.touch_m)
        if isinstance(step, LinearMove)
        and step.touch_m is not None
        and step.load_m == 0
        and i + 1 < len(plan.steps)
        and is_guarded(plan.steps[i + 1])
        else step
        for i, step in enumerate(plan.steps)
    )
    return replace(plan, steps=steps)


def blend_radius(straight_m: float) -> float:
    """The blend radius [m] of a corner at one end of a straight motion of that length, whose other end is met."""
    return min(_BLEND_M, _BLEND_SHARE * max(straight_m, 0.0))


def joint_move(label: str, q: Array, config: CellConfig, load_m: float = 0.0, blend_m: float = 0.0) -> JointMove:
    """A joint-space motion at the speed of the cell's file; see `JointMove`."""
    motion = config.motion
    return JointMove(label, q, motion.joint_speed_rad_s, motion.joint_acceleration_rad_s2, load_m, blend_m)


def linear_move(
    label: str,
    T_base_tcp: Array,
    config: CellConfig,
    load_m: float = 0.0,
    touch_m: float | None = None,
    blend_m: float = 0.0,
) -> LinearMove:
    """A straight motion at the speed of the cell's file; see `LinearMove`."""
    motion = config.motion
    speed, acceleration = motion.linear_speed_m_s, motion.linear_acceleration_m_s2
    return LinearMove(label, T_base_tcp, speed, acceleration, load_m=load_m, touch_m=touch_m, blend_m=blend_m)


def guarded_move(label: str, T_base_tcp: Array, config: CellConfig, touch_m: float) -> LinearMove:
    """A straight motion, guarded by the speed and the contact force of the cell's file; see `LinearMove`."""
    motion = config.motion
    speed, acceleration = motion.guarded_speed_m_s, motion.linear_acceleration_m_s2
    return LinearMove(label, T_base_tcp, speed, acceleration, motion.contact_force_n, touch_m=touch_m)


def home_move(config: CellConfig, load_m: float = 0.0) -> JointMove:
    """The motion to the home pose; see `JointMove`."""
    return joint_move("home", np.array(config.motion.home_q), config, load_m)
