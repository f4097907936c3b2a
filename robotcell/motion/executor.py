"""Runs a checked plan, supervised: every period the guard looks, the watchdog is kicked, a violation stops the arm."""

from __future__ import annotations

import enum
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import CellError, DeviceFault, GuardTripped
from robotcell.geometry.transforms import rotation_angle
from robotcell.motion.path_check import Guard
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove

if TYPE_CHECKING:
    from robotcell.cell import Cell
    from robotcell.geometry.transforms import Array
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.motion.plan import MotionPlan, Step

# 125 Hz: the slower of the two rates at which UR controllers report.
PERIOD_S = 0.008
# The fingers need 1 s for their full stroke; a gripper that is busy for longer hangs.
_GRIP_TIMEOUT_S = 3.0
# A commanded motion in which no joint turns further than this for so long was paused, or its speed slider is at zero.
_STALL_S = 3.0
_STILL_RAD = 0.005
# A stop from the highest speed that the limits allow takes far less.
_STOP_TIMEOUT_S = 2.0
# How far from its target a motion may have ended.
_REACHED_RAD = 0.02
_REACHED_M = 0.004


class Ending(enum.Enum):
    """How a plan ended."""

    DONE = "done"
    CONTACT = "contact"  # a guarded motion met something and stopped, or fingers pressed too hard and opened again
    EMPTY = "empty"  # the fingers held nothing when they should


@dataclass(frozen=True)
class Execution:
    """What came of a plan.

    Attributes:
        ending: how it ended.
        step: label of the step that ended it.
        peak_force_n: largest contact force during guarded motions.
        width_m: opening of the fingers at the last check for a held object; NaN without one.
    """

    ending: Ending
    step: str
    peak_force_n: float
    width_m: float


class Executor:
    """Runs plans on the devices of a cell; the cell's latch stands over all of them."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._guard = Guard(cell.config, cell.latch)

    def run(self, checked: CheckedPlan) -> Execution:
        """Run a plan to its end, or to the first contact or empty grip.

        However this ends, by an exception or by an interrupt as well, arm and fingers stand still afterwards, and
        whatever ended it early is latched.

        Raises:
            GuardTripped, DeviceFault, ConnectionLost, UnsafeMotion: as the guard and the devices do.
        """
        plan = checked.plan
        self._guard.check_start(self._cell.arm.state(), self._cell.clock.now(), plan)
        try:
            return self._run_steps(plan)
        except BaseException as error:
            self._cell.latch.trip(f"{plan.label} was cut short: {error if str(error) else type(error).__name__}")
            self._stop()
            raise

    def recover(self) -> None:
        """Leave a stop, because an operator asked for it. The next plan starts from measured joints."""
        self._cell.arm.recover()
        self._cell.latch.clear()

    def _run_steps(self, plan: MotionPlan) -> Execution:
        peak_force, width = 0.0, float("nan")
        step: Step | None = None
        for step in plan.steps:
            if isinstance(step, Grip):
                contact, force = self._grip(step)
                if contact:
                    return Execution(Ending.CONTACT, step.label, force, width)
            elif isinstance(step, CheckHold):
                width = self._cell.gripper.state().width_m
                if width < step.min_width_m:
                    return Execution(Ending.EMPTY, step.label, peak_force, width)
            else:
                contact, force = self._move(step)
                peak_force = max(peak_force, force)
                if contact:
                    return Execution(Ending.CONTACT, step.label, peak_force, width)
        return Execution(Ending.DONE, step.label if step else "", peak_force, width)

    def _move(self, step: JointMove | LinearMove) -> tuple[bool, float]:
        """Run one motion; whether a guarded one met something, and its largest contact force [N]."""
        arm = self._cell.arm
        contact_force = step.contact_force_n if isinstance(step, LinearMove) else None
        # Force sensors drift, so contact is judged against the force before the motion.
        wrench_before = arm.state().wrench
        if isinstance(step, JointMove):
            arm.start_joints(step.q, step.speed_rad_s, step.acceleration_rad_s2)
        else:
            arm.start_linear(step.T_base_tcp, step.speed_m_s, step.acceleration_m_s2)
        peak, contact = 0.0, False
        moved_at, q_moved = self._cell.clock.now(), arm.state().q
        while arm.moving:
            state, now = arm.state(), self._cell.clock.now()
            self._guard.check(state, now)
            if float(np.abs(state.q - q_moved).max()) > _STILL_RAD:
                moved_at, q_moved = now, state.q
            elif now - moved_at > _STALL_S:
                raise GuardTripped(
                    f"step {step.label!r} stood still for {_STALL_S:.0f} s: check the speed slider and that the "
                    "program is not paused, look at the cell, then recover"
                )
            if contact_force is not None and not contact:
                force = float(np.linalg.norm((state.wrench - wrench_before)[:3]))
                peak = max(peak, force)
                if force > contact_force:
                    contact = True
                    arm.stop()
            arm.kick()
            self._cell.clock.sleep(PERIOD_S)
        state = arm.state()
        self._guard.check(state, self._cell.clock.now())
        if not contact:
            self._check_reached(step, state.q, state.T_base_tcp)
        return contact, peak

    def _check_reached(self, step: JointMove | LinearMove, q: Array, T_base_tcp: Array) -> None:
        if isinstance(step, JointMove):
            off = float(np.abs(q - step.q).max())
            reached, missing = off <= _REACHED_RAD, f"{off:.3f} rad"
        else:
            off = float(np.linalg.norm(T_base_tcp[:3, 3] - step.T_base_tcp[:3, 3]))
            turned = rotation_angle(T_base_tcp[:3, :3], step.T_base_tcp[:3, :3])
            reached, missing = off <= _REACHED_M and turned <= _REACHED_RAD, f"{1000 * off:.1f} mm"
        if not reached:
            raise GuardTripped(
                f"step {step.label!r} ended {missing} from its target: something stopped the arm; look at the cell, "
                "then recover"
            )

    def _grip(self, step: Grip) -> tuple[bool, float]:
        """Move the fingers; whether they met more than they may press on, and their largest contact force [N].

        The arm stands, and is watched and kept awake all the same.
        """
        arm, gripper, clock = self._cell.arm, self._cell.gripper, self._cell.clock
        limit = step.contact_force_n
        wrench_before, width_before = arm.state().wrench, gripper.state().width_m
        peak = 0.0
        gripper.start_width(step.width_m, step.force_n)
        deadline = clock.now() + _GRIP_TIMEOUT_S
        # The first sleep lets a command reach the fingers before they are asked whether they move.
        clock.sleep(PERIOD_S)
        while gripper.state().busy:
            state = arm.state()
            self._guard.check(state, clock.now())
            peak = max(peak, float(np.linalg.norm((state.wrench - wrench_before)[:3])))
            if limit is not None and peak > limit:
                self._grip(Grip(f"open after {step.label!r}", width_before, step.force_n))
                return True, peak
            arm.kick()
            if clock.now() > deadline:
                raise DeviceFault(
                    f"the gripper was still busy {_GRIP_TIMEOUT_S:.0f} s after {step.label!r}; "
                    "power-cycle it at the Compute Box, then recover"
                )
            clock.sleep(PERIOD_S)
        return False, peak

    def _stop(self) -> None:
        """Stop arm and fingers and wait for standstill; an arm that is lost is stopped by its own controller."""
        arm, gripper, clock = self._cell.arm, self._cell.gripper, self._cell.clock
        # The arm first: a gripper that does not answer must not delay it.
        with suppress(CellError):
            arm.stop()
        with suppress(CellError):
            gripper.stop()
        with suppress(CellError):
            deadline = clock.now() + _STOP_TIMEOUT_S
            while arm.moving and clock.now() < deadline:
                arm.kick()
                clock.sleep(PERIOD_S)
