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
from robotcell.interfaces import JointWaypoint, LinearWaypoint
from robotcell.motion.course import course_of, standing
from robotcell.motion.guard import Guard, Latch
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove, Shape, blended, is_guarded
from robotcell.motion.recorder import Recorder, StateLog

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import ArmState, Devices, Waypoint
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
    EMPTY = "empty"  # the fingers held nothing when they should


@dataclass(frozen=True)
class Execution:
    """What came of a plan.

    Attributes:
        ending: how it ended.
        step: label of the step that ended it.
        peak_force_n: largest contact force during guarded motions, and of the grip that ended it.
        grip_force_n: largest contact force while the fingers gripped; NaN if they never did.
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
        self._beside: Callable[[], None] = lambda: None

    def run(
        self,
        checked: CheckedPlan,
        held: Callable[[str], None] = lambda _: None,
        beside: Callable[[], None] = lambda: None,
    ) -> Execution:
        """Run a plan to its end, or to the first contact or empty grip.

        Args:
            checked: the plan.
            held: called, while the arm stands, with the label of each `CheckHold` that something was held at.
            beside: is called in every supervision period once the last guarded motion and grip are over; it must return
                at once.

        However this ends, by an exception or by an interrupt as well, the arm stands still afterwards, and whatever
        ended it early is latched. So do the fingers, but for those of a `Shape` at the end of the plan, which go on to
        where they were sent. What arm and fingers did in the last second before such a stop is in a file, which the
        error names.

        Raises:
            GuardTripped, DeviceFault, ConnectionLost, UnsafeMotion: as the guard and the devices do.
        """
        plan = checked.plan
        self._guard.check_start(self._devices.arm.state(), self._devices.clock.now(), plan)
        try:
            return self._run_steps(checked, held, beside)
        except BaseException as error:
            reason = f"{plan.label} was cut short: {error if str(error) else type(error).__name__}"
            self._latch.trip(reason)
            stopped_at = self._devices.clock.now()
            self._stop()
            unkept = self._latch.keep(self._measured_joints())
            self._record(error, plan.label, reason, stopped_at)
            if unkept and isinstance(error, CellError):
                raise type(error)(f"{error}; {unkept}", device=error.device) from error
            raise

    def _measured_joints(self) -> Array | None:
        with suppress(CellError):
            return self._devices.arm.state().q
        return None

    def _run_steps(self, checked: CheckedPlan, held: Callable[[str], None], beside: Callable[[], None]) -> Execution:
        steps, lowest = checked.plan.steps, checked.lowest_tip_m
        peak_force, grip_force, width, held_m = 0.0, math.nan, math.nan, math.nan
        ending, label, shaping = Ending.DONE, "", False
        touching = max((i for i, step in enumerate(steps) if isinstance(step, Grip) or is_guarded(step)), default=-1)
        for group in blended(steps):
            step = steps[group[0]]
            label = step.label
            self._beside = beside if group[0] > touching else lambda: None
            if shaping and (isinstance(step, Grip | CheckHold) or is_guarded(step)):
                self._fingers_move(lowest)
                shaping = False
            if isinstance(step, CheckHold):
                width, held_m = self._look_at_fingers(), step.min_width_m
                if width < held_m:
                    ending = Ending.EMPTY
                else:
                    held(label)
            elif isinstance(step, Shape):
                self._shape(step, lowest)
                shaping, held_m = True, math.nan
            elif isinstance(step, Grip):
                contact, force = self._grip(step, lowest)
                held_m = math.nan
                grip_force = force if math.isnan(grip_force) else max(grip_force, force)
                if contact:
                    ending, peak_force = Ending.CONTACT, max(peak_force, force)
            else:
                ending, label, force, seen_m = self._move(checked, group, held_m)
                peak_force, width = max(peak_force, force), width if math.isnan(seen_m) else seen_m
                checks = [step for i in group if isinstance(step := steps[i], CheckHold)]
                # Told here, not as the arm passes the corner: a journal takes longer than a period.
                for check in checks if ending is Ending.DONE else ():
                    held(check.label)
                held_m = checks[-1].min_width_m if checks else held_m
            if ending is not Ending.DONE:
                break
        return Execution(ending, label, peak_force, grip_force, width)

    def _move(self, checked: CheckedPlan, group: tuple[int, ...], held_m: float) -> tuple[Ending, str, float, float]:
        """Run one motion, of one step or of several that are blended, with the checks for a held object between them.

        Args:
            checked: the plan.
            group: numbers of the steps.
            held_m: an opening of the fingers [m] below which they have lost their load; NaN where they hold nothing.

        Returns:
            How it ended (CONTACT where a guarded motion met something, EMPTY where the load was lost), at which step,
            the peak force of a guarded one [N], and the opening of the fingers at the last check, or when the load was
            lost; NaN without one.
        """
        arm = self._devices.arm
        moves = [step for i in group if isinstance(step := checked.plan.steps[i], JointMove | LinearMove)]
        last, path = moves[-1], np.vstack([checked.joint_paths[i] for i in group])
        # How many samples of the path each check comes after.
        lengths = np.cumsum([len(checked.joint_paths[i]) for i in group])
        checks = [(int(lengths[k]), checked.plan.steps[i]) for k, i in enumerate(group)]
        holds = [(after, step) for after, step in checks if isinstance(step, CheckHold)]
        contact_force = last.contact_force_n if isinstance(last, LinearMove) else None
        # Force sensors drift, so contact is judged against the force before the motion.
        start = arm.state()
        self._guard.begin(course_of(moves, path, checked.lowest_tip_m), start)
        arm.start_path([waypoint(move, self._speed_fraction) for move in moves])
        peak, width, passed, periods = 0.0, math.nan, 0, 0
        ending, label = Ending.DONE, last.label
        self._period_began = moved_at = self._devices.clock.now()
        q_moved = start.q
        moving = True
        while moving:
            moving = arm.moving
            state, now = self._watch()
            if float(np.abs(state.q - q_moved).max()) > _STILL_RAD:
                moved_at, q_moved = now, state.q
            elif now - moved_at > _STALL_S:
                raise GuardTripped(
                    f"step {label!r} stood still for {_STALL_S:.0f} s: check the speed slider and that the "
                    "program is not paused, look at the cell, then run robotcell recover"
                )
            if contact_force is not None and ending is Ending.DONE:
                force = float(np.linalg.norm((state.wrench - start.wrench)[:3]))
                peak = max(peak, force)
                if force > contact_force:
                    ending = Ending.CONTACT
                    arm.stop()
            passed = _follow(path, passed, state.q) if moving else len(path)
            while holds and ending is Ending.DONE and passed >= holds[0][0]:
                check = holds.pop(0)[1]
                width, held_m = self._look_at_fingers(), check.min_width_m
                if width < held_m:
                    ending, label = Ending.EMPTY, check.label
                    arm.stop()
            periods += 1
            if periods % _PERIODS_PER_LOOK == 0 and ending is Ending.DONE and self._look_at_fingers(held_m) < held_m:
                ending, width = Ending.EMPTY, self._width_m
                arm.stop()
            if moving:
                self._end_period()
        if ending is Ending.DONE:
            self._check_reached(last, state.q, state.T_base_tcp)
        return ending, label, peak, width

    def _look_at_fingers(self, held_m: float = 0.0) -> float:
        """Their opening [m]; NaN where they hold nothing (`held_m` is NaN), and need not be asked."""
        if math.isnan(held_m):
            return math.nan
        self._width_m = self._devices.gripper.state().width_m
        return self._width_m

    def _watch(self) -> tuple[ArmState, float]:
        """Let the guard look at the newest state of the arm; that state, and when it was looked at [s]."""
        state, now = self._devices.arm.state(), self._devices.clock.now()
        self._log.add(state, self._width_m)
        self._guard.check(state, now)
        return state, now

    def _end_period(self) -> None:
        """Kick the watchdog and wait for the next period, whatever the work of this one took."""
        self._devices.arm.kick()
        self._beside()
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
                "then run robotcell recover"
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
                    "power-cycle it at the Compute Box, then run robotcell recover",
                    device="gripper",
                )
            self._end_period()
        return False, peak

    def _shape(self, step: Shape, lowest_tip_m: float) -> None:
        """Send the fingers off, and wait until their opening has changed by what the step asks for."""
        gripper = self._devices.gripper
        before = gripper.state().width_m
        gripper.start_width(step.width_m, step.force_n)
        if step.clear_m > 0:
            self._fingers_move(lowest_tip_m, lambda width_m: abs(width_m - before) >= step.clear_m)

    def _fingers_move(self, lowest_tip_m: float, enough: Callable[[float], bool] = lambda _: False) -> None:
        """Watch the standing arm until the fingers have come to rest, or far enough by their opening [m]."""
        gripper, clock = self._devices.gripper, self._devices.clock
        start = self._devices.arm.state()
        self._guard.begin(standing("fingers", start.q, lowest_tip_m), start)
        deadline = clock.now() + _GRIP_TIMEOUT_S
        # The first sleep lets a command reach the fingers before they are asked whether they move.
        clock.sleep(PERIOD_S)
        self._period_began = clock.now()
        while (fingers := gripper.state()).busy and not enough(fingers.width_m):
            self._width_m = fingers.width_m
            self._watch()
            if clock.now() > deadline:
                raise DeviceFault(
                    f"the gripper was still busy after {_GRIP_TIMEOUT_S:.0f} s; power-cycle it at the Compute Box, "
                    "then run robotcell recover",
                    device="gripper",
                )
            self._end_period()

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


def waypoint(move: JointMove | LinearMove, pace: float = 1.0) -> Waypoint:
    """What the arm is told of a motion at a share of its speed; its path in space is the same at any pace."""
    if isinstance(move, JointMove):
        return JointWaypoint(move.q, pace * move.speed_rad_s, pace**2 * move.acceleration_rad_s2, move.blend_m)
    return LinearWaypoint(move.T_base_tcp, pace * move.speed_m_s, pace**2 * move.acceleration_m_s2, move.blend_m)


def _follow(path: Array, passed: int, q: Array) -> int:
    """How many samples of a path (N, 6) lie behind joint angles (6,) that were nearest to number `passed` before."""
    while passed + 1 < len(path) and np.abs(q - path[passed + 1]).max() <= np.abs(q - path[passed]).max():
        passed += 1
    return passed
