"""Runs a checked plan, supervised: every period the guard looks, the watchdog is kicked, a violation stops the arm."""

from __future__ import annotations

import enum
import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import CellError, DeviceFault, GuardTripped, StorageError
from robotcell.geometry.transforms import rotation_angle
from robotcell.motion.course import course_of, standing
from robotcell.motion.guard import Guard, Latch
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove
from robotcell.motion.recorder import Recorder, StateLog

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import ArmState, Devices
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
# While something is carried the fingers are asked in one period of so many: their link is slower than the arm's.
_PERIODS_PER_LOOK = 4


class Ending(enum.Enum):
    """How a plan ended."""

    DONE = "done"
    CONTACT = "contact"  # a guarded motion met something and stopped, or fingers pressed too hard and opened again
    EMPTY = "empty"  # the fingers held nothing when they should, or lost it on the way


@dataclass(frozen=True)
class Execution:
    """What came of a plan.

    Attributes:
        ending: how it ended.
        step: label of the step that ended it.
        peak_force_n: largest contact force during guarded motions, and of the grip that ended it.
        grip_force_n: largest contact force while the fingers moved; NaN if they never did.
        width_m: opening of the fingers at the last check for a held object, or when it was lost; NaN without one.
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
        recorder: where the last second before a stop is written; `stops` in the folder of the runs unless given.
    """

    def __init__(self, devices: Devices, config: CellConfig, latch: Latch, recorder: Recorder | None = None) -> None:
        self._devices = devices
        self._latch = latch
        self._guard = Guard(config, latch)
        self._recorder = recorder or Recorder()
        self._stops = config.journal.runs / "stops"
        self._speed_fraction = config.motion.speed_fraction
        self._log = StateLog()
        # Of the fingers, as they were last asked [m].
        self._width_m = math.nan
        self._period_began = 0.0

    def run(self, checked: CheckedPlan) -> Execution:
        """Run a plan to its end, or to the first contact or empty grip.

        However this ends, by an exception or by an interrupt as well, arm and fingers stand still afterwards, and
        whatever ended it early is latched. What they did in the last second before it is then in a file, which the
        error names.

        Raises:
            GuardTripped, DeviceFault, ConnectionLost, UnsafeMotion: as the guard and the devices do.
        """
        plan = checked.plan
        self._guard.check_start(self._devices.arm.state(), self._devices.clock.now(), plan)
        try:
            return self._run_steps(checked)
        except BaseException as error:
            reason = f"{plan.label} was cut short: {error if str(error) else type(error).__name__}"
            self._latch.trip(reason)
            stopped_at = self._devices.clock.now()
            self._stop()
            self._record(error, plan.label, reason, stopped_at)
            raise

    def _run_steps(self, checked: CheckedPlan) -> Execution:
        peak_force, grip_force, width, held_m = 0.0, math.nan, math.nan, math.nan
        ending, label = Ending.DONE, ""
        for step, path in zip(checked.plan.steps, checked.joint_paths, strict=True):
            label = step.label
            if isinstance(step, CheckHold):
                width, held_m = self._look_at_fingers(), step.min_width_m
                if width < held_m:
                    ending = Ending.EMPTY
                    break
                continue
            if isinstance(step, Grip):
                contact, force = self._grip(step, checked.lowest_tip_m)
                held_m = math.nan
                grip_force = force if math.isnan(grip_force) else max(grip_force, force)
                peak_force = max(peak_force, force) if contact else peak_force
            else:
                ending, force = self._move(step, path, checked.lowest_tip_m, held_m)
                peak_force = max(peak_force, force)
                contact = ending is Ending.CONTACT
                width = self._width_m if ending is Ending.EMPTY else width
            if contact:
                ending = Ending.CONTACT
            if ending is not Ending.DONE:
                break
        return Execution(ending, label, peak_force, grip_force, width)

    def _move(
        self, step: JointMove | LinearMove, path: Array, lowest_tip_m: float, held_m: float
    ) -> tuple[Ending, float]:
        """Run one motion.

        Args:
            step: the motion.
            path: joint angles (N, 6) [rad] along it, as they were checked.
            lowest_tip_m: see `CheckedPlan`.
            held_m: an opening of the fingers [m] below which they have lost their load; NaN where they hold nothing.

        Returns:
            CONTACT where a guarded motion met something, EMPTY where the load was lost on the way, or DONE; and the
            peak force of a guarded motion [N].
        """
        arm = self._devices.arm
        contact_force = step.contact_force_n if isinstance(step, LinearMove) else None
        # Force sensors drift, so contact is judged against the force before the motion.
        start = arm.state()
        wrench_before = start.wrench
        self._guard.begin(course_of(step, path, lowest_tip_m), start)
        pace = self._speed_fraction
        if isinstance(step, JointMove):
            arm.start_joints(step.q, pace * step.speed_rad_s, pace**2 * step.acceleration_rad_s2)
        else:
            arm.start_linear(step.T_base_tcp, pace * step.speed_m_s, pace**2 * step.acceleration_m_s2)
        peak, ending, periods = 0.0, Ending.DONE, 0
        self._period_began = moved_at = self._devices.clock.now()
        q_moved = start.q
        while arm.moving:
            state, now = self._watch()
            if float(np.abs(state.q - q_moved).max()) > _STILL_RAD:
                moved_at, q_moved = now, state.q
            elif now - moved_at > _STALL_S:
                raise GuardTripped(
                    f"step {step.label!r} stood still for {_STALL_S:.0f} s: check the speed slider and that the "
                    "program is not paused, look at the cell, then recover"
                )
            if contact_force is not None and ending is Ending.DONE:
                force = float(np.linalg.norm((state.wrench - wrench_before)[:3]))
                peak = max(peak, force)
                if force > contact_force:
                    ending = Ending.CONTACT
                    arm.stop()
            periods += 1
            if periods % _PERIODS_PER_LOOK == 0 and ending is Ending.DONE and self._look_at_fingers(held_m) < held_m:
                ending = Ending.EMPTY
                arm.stop()
            self._end_period()
        state, _ = self._watch()
        if ending is Ending.DONE:
            self._check_reached(step, state.q, state.T_base_tcp)
        return ending, peak

    def _look_at_fingers(self, held_m: float = 0.0) -> float:
        """Their opening [m]; NaN where they hold nothing (`held_m` is NaN), and need not be asked."""
        if not math.isnan(held_m):
            self._width_m = self._devices.gripper.state().width_m
        return self._width_m if not math.isnan(held_m) else math.nan

    def _watch(self) -> tuple[ArmState, float]:
        """Let the guard look at the newest state of the arm; that state, and when it was looked at [s]."""
        state, now = self._devices.arm.state(), self._devices.clock.now()
        self._log.add(state, self._width_m)
        self._guard.check(state, now)
        return state, now

    def _end_period(self) -> None:
        """Kick the watchdog and wait for the next period, whatever the work of this one took."""
        self._devices.arm.kick()
        clock = self._devices.clock
        clock.sleep(max(PERIOD_S - (clock.now() - self._period_began), 0.0))
        self._period_began = clock.now()

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

    def _grip(self, step: Grip, lowest_tip_m: float) -> tuple[bool, float]:
        """Move the fingers; whether they met more than they may press on, and their largest contact force [N].

        The arm stands, and is watched and kept awake all the same.
        """
        arm, gripper, clock = self._devices.arm, self._devices.gripper, self._devices.clock
        limit = step.contact_force_n
        start, width_before = arm.state(), gripper.state().width_m
        self._guard.begin(standing(step.label, start.q, lowest_tip_m), start)
        peak = 0.0
        gripper.start_width(step.width_m, step.force_n)
        deadline = clock.now() + _GRIP_TIMEOUT_S
        # The first sleep lets a command reach the fingers before they are asked whether they move.
        clock.sleep(PERIOD_S)
        self._period_began = clock.now()
        while (fingers := gripper.state()).busy:
            self._width_m = fingers.width_m
            state, _ = self._watch()
            peak = max(peak, float(np.linalg.norm((state.wrench - start.wrench)[:3])))
            if limit is not None and peak > limit:
                self._grip(Grip(f"open after {step.label!r}", width_before, step.force_n), lowest_tip_m)
                return True, peak
            if clock.now() > deadline:
                raise DeviceFault(
                    f"the gripper was still busy {_GRIP_TIMEOUT_S:.0f} s after {step.label!r}; "
                    "power-cycle it at the Compute Box, then recover",
                    device="gripper",
                )
            self._end_period()
        return False, peak

    def _record(self, error: BaseException, label: str, reason: str, stopped_at: float) -> None:
        """Write the last second down, and have the error name the file."""
        try:
            path = self._log.save(self._recorder.folder or self._stops, label, reason, stopped_at)
        except StorageError as problem:
            words = f"the last second could not be written: {problem}"
        else:
            words = f"the last second is in {path}" if path else ""
        if words and isinstance(error, CellError):
            error.args = (f"{error}; {words}",)

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
                self._log.add(arm.state(), self._width_m)
                arm.kick()
                clock.sleep(PERIOD_S)
            self._log.add(arm.state(), self._width_m)
