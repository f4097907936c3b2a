"""Runs a checked plan, supervised: every period the guard looks, the watchdog is kicked, a violation stops the arm."""

from __future__ import annotations

import enum
import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import CellError, DeviceFault, GuardTripped
from robotcell.geometry.transforms import rotation_angle
from robotcell.motion.guard import Guard, Latch
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Devices
    from robotcell.motion.path_check import CheckedPlan

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
# A straight motion that ends with joints this far from those that were checked went another way. The kinematics of a
# real arm differ from the nominal ones by up to a centimetre, a fifth of this at the arm's reach.
_SAME_WAY_RAD = 0.1


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
        peak_force_n: largest contact force during guarded motions, and of the grip that ended it.
        grip_force_n: largest contact force while the fingers moved; NaN if they never did.
        width_m: opening of the fingers at the last check for a held object; NaN without one.
    """

    ending: Ending
    step: str
    peak_force_n: float
    grip_force_n: float
    width_m: float


class Executor:
    """Runs plans on the devices of a cell.

    Args:
        devices: of the cell.
        config: of the cell.
        latch: of the cell: it stands over all executors.
    """

    def __init__(self, devices: Devices, config: CellConfig, latch: Latch) -> None:
        self._devices = devices
        self._latch = latch
        self._guard = Guard(config, latch)

    def run(self, checked: CheckedPlan, held: Callable[[str], None] | None = None) -> Execution:
        """Run a plan to its end, or to the first contact or empty grip.

        Args:
            checked: the plan.
            held: called with the label of each `CheckHold` that something was held at, before the next step.

        However this ends, by an exception or by an interrupt as well, arm and fingers stand still afterwards, and
        whatever ended it early is latched.

        Raises:
            GuardTripped, DeviceFault, ConnectionLost, UnsafeMotion: as the guard and the devices do.
        """
        plan = checked.plan
        self._guard.check_start(self._devices.arm.state(), self._devices.clock.now(), plan)
        try:
            return self._run_steps(checked, held)
        except BaseException as error:
            self._latch.trip(f"{plan.label} was cut short: {error if str(error) else type(error).__name__}")
            self._stop()
            unkept = self._latch.keep(self._measured_joints())
            if unkept and isinstance(error, CellError):
                raise type(error)(f"{error}; {unkept}", device=error.device) from error
            raise

    def _measured_joints(self) -> Array | None:
        with suppress(CellError):
            return self._devices.arm.state().q
        return None

    def _run_steps(self, checked: CheckedPlan, held: Callable[[str], None] | None) -> Execution:
        peak_force, grip_force, width = 0.0, math.nan, math.nan
        ending, label = Ending.DONE, ""
        for step, path in zip(checked.plan.steps, checked.joint_paths, strict=True):
            label = step.label
            if isinstance(step, CheckHold):
                width = self._devices.gripper.state().width_m
                if width < step.min_width_m:
                    ending = Ending.EMPTY
                    break
                if held is not None:
                    held(label)
                continue
            if isinstance(step, Grip):
                contact, force = self._grip(step, checked.lowest_tip_m)
                grip_force = force if math.isnan(grip_force) else max(grip_force, force)
                peak_force = max(peak_force, force) if contact else peak_force
            else:
                contact, force = self._move(step, path, checked.lowest_tip_m)
                peak_force = max(peak_force, force)
            if contact:
                ending = Ending.CONTACT
                break
        return Execution(ending, label, peak_force, grip_force, width)

    def _move(self, step: JointMove | LinearMove, path: Array, lowest_tip_m: float) -> tuple[bool, float]:
        """Run one motion, checked as path (N, 6) [rad]; whether a guarded one met something, and its peak force [N]."""
        arm = self._devices.arm
        contact_force = step.contact_force_n if isinstance(step, LinearMove) else None
        # Force sensors drift, so contact is judged against the force before the motion.
        wrench_before = arm.state().wrench
        if isinstance(step, JointMove):
            arm.start_joints(step.q, step.speed_rad_s, step.acceleration_rad_s2)
        else:
            arm.start_linear(step.T_base_tcp, step.speed_m_s, step.acceleration_m_s2)
        peak, contact = 0.0, False
        moved_at, q_moved = self._devices.clock.now(), arm.state().q
        while arm.moving:
            state, now = arm.state(), self._devices.clock.now()
            self._guard.check(state, now, lowest_tip_m)
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
            self._devices.clock.sleep(PERIOD_S)
        state = arm.state()
        self._guard.check(state, self._devices.clock.now(), lowest_tip_m)
        if not contact:
            self._check_reached(step, path[-1], state.q, state.T_base_tcp)
        return contact, peak

    def _check_reached(self, step: JointMove | LinearMove, q_end: Array, q: Array, T_base_tcp: Array) -> None:
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
        away = np.abs(q - q_end)
        if away.max() > _SAME_WAY_RAD:
            raise GuardTripped(
                f"step {step.label!r} ended with joint {int(away.argmax()) + 1} {away.max():.2f} rad from where the "
                "checked path ends: the arm took another way; look at the cell, then recover"
            )

    def _grip(self, step: Grip, lowest_tip_m: float) -> tuple[bool, float]:
        """Move the fingers; whether they met more than they may press on, and their largest contact force [N].

        The arm stands, and is watched and kept awake all the same.
        """
        arm, gripper, clock = self._devices.arm, self._devices.gripper, self._devices.clock
        limit = step.contact_force_n
        wrench_before, width_before = arm.state().wrench, gripper.state().width_m
        peak = 0.0
        gripper.start_width(step.width_m, step.force_n)
        deadline = clock.now() + _GRIP_TIMEOUT_S
        # The first sleep lets a command reach the fingers before they are asked whether they move.
        clock.sleep(PERIOD_S)
        while gripper.state().busy:
            state = arm.state()
            self._guard.check(state, clock.now(), lowest_tip_m)
            peak = max(peak, float(np.linalg.norm((state.wrench - wrench_before)[:3])))
            if limit is not None and peak > limit:
                self._grip(Grip(f"open after {step.label!r}", width_before, step.force_n), lowest_tip_m)
                return True, peak
            arm.kick()
            if clock.now() > deadline:
                raise DeviceFault(
                    f"the gripper was still busy {_GRIP_TIMEOUT_S:.0f} s after {step.label!r}; "
                    "power-cycle it at the Compute Box, then recover",
                    device="gripper",
                )
            clock.sleep(PERIOD_S)
        return False, peak

    def _stop(self) -> None:
        """Stop arm and fingers and wait for standstill; an arm that is lost is stopped by its own controller."""
        arm, gripper, clock = self._devices.arm, self._devices.gripper, self._devices.clock
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
