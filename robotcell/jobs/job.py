"""Pick-goal and pick-all: look, decide, plan, check, run, judge, until the request is met or given up.

A job is the loop around that line. What it did is in the journal; whoever wants to follow it is an observer.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from robotcell.errors import CalibrationError, CellError, ConfigError, DeviceFault, NoTarget, UnsafeMotion
from robotcell.geometry.bodies import blocks_view
from robotcell.jobs.journal import ActionRow, Frame, Journal, Metrics, OutcomeRow
from robotcell.jobs.policy_api import Action, Observation, Policy, Primitive
from robotcell.motion.executor import Ending, Execution, Executor
from robotcell.motion.path_check import check_config, check_plan
from robotcell.motion.plan import HELD_AFTER_LIFT, plan_action, plan_retreat, push_segment
from robotcell.perception.heightmap import Heightmap, build_heightmap
from robotcell.perception.segmentation import Instance, Segmentation, find_goal, segment
from robotcell.perception.tags import check_tags

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from robotcell.cell import Cell
    from robotcell.config.schema import CellConfig
    from robotcell.interfaces import RgbdFrame
    from robotcell.motion.plan import MotionPlan

# Paper, section "The problem": at most 5 pushes in a row for one goal; "Evaluation": 10 consecutive failed
# attempts end a run.
MAX_PUSHES_IN_A_ROW = 5
MAX_FAILURES_IN_A_ROW = 10
# A cell whose height changes by more than this has changed hands; five times the depth noise of the camera.
_CHANGED_M = 0.010
# A push moves what is this near to its way, and what that meets.
_STIRRED_M = 0.06
# A goal that was seen may reach so far beyond the part of it that was.
_UNSEEN_PART_M = 0.02
# An object has left its place when this share of the cells that show it is lower than before.
_GONE_SHARE = 0.6
# A push after which less of the table than this looks different moved nothing: a third of a block's smallest face.
_MOVED_M2 = 400e-6
# What changed must be at least this wide to count: the noise of depth flickers along edges, a cell or two wide.
_MOVED_WIDTH_M = 0.007
# The fingers can only have taken an object that was seen this close to them.
_REACH_M = 0.06


class Result(str, enum.Enum):
    """What an action came to."""

    PICKED = "picked"
    WRONG_OBJECT = "wrong object"
    MISSED = "missed"  # the fingers closed on nothing
    LOST = "lost"  # held after the lift, no longer over the bin
    COLLIDED = "collided"  # something was in the way of the fingers
    UNCONFIRMED = "unconfirmed"  # the gripper held something that the camera does not miss
    PUSHED = "pushed"
    NOTHING_MOVED = "nothing moved"
    REFUSED = "refused"  # the plan was unsafe; nothing moved
    STOPPED = "stopped"  # a device or the safety layer stopped the cell


# After these the scene is another one, and what failed before may work now.
_SCENE_CHANGED = {Result.PICKED, Result.WRONG_OBJECT, Result.PUSHED, Result.LOST, Result.UNCONFIRMED}


@dataclass(frozen=True)
class View:
    """One look at the table."""

    frame: RgbdFrame
    heightmap: Heightmap
    segmentation: Segmentation


@dataclass(frozen=True)
class Decision:
    """An action about to be run."""

    index: int
    goal: str | None
    view: View
    action: Action


@dataclass(frozen=True)
class Outcome:
    """What came of a decision; `picked` is the colour of the object that left the table."""

    result: Result
    picked: str | None
    detail: str
    peak_force_n: float

    @property
    def success(self) -> bool:
        """Whether the action did what it was for."""
        return self.result in {Result.PICKED, Result.PUSHED}


@dataclass(frozen=True)
class Report:
    """How a job ended; `reason` says why one that is not complete was given up."""

    job_id: int
    run_dir: Path
    completed: bool
    reason: str
    metrics: Metrics
    cell_s: float


class Observer(Protocol):
    """Follows a job."""

    def started(self, job_id: int, run_dir: Path) -> None:
        """The job is in the journal and its folder is made."""
        ...

    def looked(self, view: View) -> None:
        """The camera was read."""
        ...

    def decided(self, decision: Decision) -> None:
        """An action is about to run."""
        ...

    def ended(self, decision: Decision, outcome: Outcome) -> None:
        """An action ended."""
        ...


def look(cell: Cell) -> View:
    """Read the camera and see what is on the table.

    Raises:
        ConnectionLost, DeviceFault: the camera delivers nothing, or a stale or sparse frame.
        CalibrationError: the table is not where the configuration has it, or a fixed tag not where it was.
    """
    config, limits = cell.config, cell.config.limits
    if blocks_view(cell.arm.state().q, config):
        raise DeviceFault("the arm stands between the camera and the workspace: move it to the home pose, then look")
    frame = cell.camera.read()
    age = cell.clock.now() - frame.t
    if age > limits.frame_age_s:
        raise DeviceFault(f"frame {frame.number} is {age:.2f} s old (limit {limits.frame_age_s} s): check the camera")
    if config.camera.measured is not None:
        check_tags(frame.color, config.camera.measured.tags)
    heightmap = build_heightmap(frame, config.camera.pose(), config.workspace, config.table.height_m)
    # Without the gaps between pixels, which say something of the resolution and nothing of the view.
    coverage = float(np.isfinite(heightmap.closed_m).mean())
    if coverage < limits.min_coverage:
        raise DeviceFault(
            f"the camera sees {coverage:.0%} of the workspace (limit {limits.min_coverage:.0%}): check its view, its "
            "lens and the light; cells finer than its pixels (workspace.resolution_m) stay empty too"
        )
    table = heightmap.table
    if table is None:
        raise CalibrationError("too little of the table is seen to tell where it is: clear a part of the workspace")
    if table.tilt_rad > limits.max_tilt_rad or abs(table.offset_m) > limits.max_table_offset_m:
        raise CalibrationError(
            f"the table appears tilted by {np.degrees(table.tilt_rad):.2f} degrees and {1000 * table.offset_m:+.1f} mm "
            f"off (limits {np.degrees(limits.max_tilt_rad):.2f} degrees, {1000 * limits.max_table_offset_m:.1f} mm): "
            "check table.height_m and the camera's pose, calibrate again if it was moved"
        )
    return View(frame, heightmap, segment(heightmap))


def preview(cell: Cell, policy: Policy, goal: str | None) -> tuple[Decision, MotionPlan]:
    """Look, decide, plan and check one action; nothing moves.

    Raises:
        ConfigError, NoTarget, UnsafeMotion and what `look` raises.
    """
    check_config(cell.config)
    view = look(cell)
    action = policy.decide(_observe(view, goal, (), may_push=True))
    plan = plan_action(action, view.heightmap, cell.arm.state().q, cell.config)
    return Decision(1, goal, view, action), check_plan(plan, cell.config).plan


def run_job(
    cell: Cell,
    policy: Policy,
    journal: Journal,
    goals: tuple[str, ...] | None,
    observers: tuple[Observer, ...] = (),
) -> Report:
    """Pick the goals (colours) in their order, or with None everything on the table.

    A goal that is not on the table when its turn comes ends the job; the report's reason lists what is there. What
    hides a goal that was seen before is pushed aside.

    Raises:
        ConfigError: the configuration does not fit together, or the folder of the run cannot be made.
        DeviceFault, ConnectionLost, GuardTripped, CalibrationError, UnsafeMotion: the cell was stopped. The journal
            has it; after a motion was cut short, the cell's latch holds until `Executor.recover`.
    """
    check_config(cell.config)
    run_dir = make_run_dir(cell.config.journal.runs, "-".join(goals) if goals else "all")
    started = cell.clock.now()
    status, reason = "stopped", ""
    # A database URL may hold a password.
    settings = cell.config.model_dump(mode="json", exclude={"journal": {"url"}})
    job_id = journal.start_job(goals, policy.name, settings, run_dir)
    try:
        for observer in observers:
            observer.started(job_id, run_dir)
        job = _Job(cell, policy, journal, observers, job_id, run_dir)
        reason = job.pick_in_order(goals) if goals else job.pick_all()
        status = "incomplete" if reason else "complete"
    except BaseException as error:
        reason = _describe(error)
        raise
    finally:
        cell_s = cell.clock.now() - started
        journal.end_job(job_id, status, reason, cell_s)
    return Report(job_id, run_dir, not reason, reason, journal.metrics(job_id), cell_s)


@dataclass
class _Job:
    cell: Cell
    policy: Policy
    journal: Journal
    observers: tuple[Observer, ...]
    job_id: int
    run_dir: Path
    actions: int = 0
    executor: Executor = field(init=False)

    def __post_init__(self) -> None:
        self.executor = Executor(self.cell)

    def pick_in_order(self, goals: tuple[str, ...]) -> str:
        """Pick one goal after the other; "" or why it was given up."""
        view = self._start()
        for goal in goals:
            view, reason = self._pick_until(goal, view)
            if reason:
                return reason
        return ""

    def pick_all(self) -> str:
        """Pick until nothing is left; "" or why it was given up."""
        _view, reason = self._pick_until(None, self._start())
        return reason

    def _start(self) -> View:
        """Go home from wherever the arm stands, and look."""
        state = self.cell.arm.state()
        off = np.abs(state.q - np.array(self.cell.config.motion.home_q)).max()
        if off > 0.01:
            self._retreat()
        return self._look()

    def _look(self) -> View:
        view = look(self.cell)
        for observer in self.observers:
            observer.looked(view)
        return view

    def _pick_until(self, goal: str | None, view: View) -> tuple[View, str]:
        """Act until the goal (or, with None, everything) is picked; the last view, and why it was given up."""
        failures = pushes = 0
        # Where the goal may be if it is not seen any more.
        place: npt.NDArray[np.bool_] | None = None
        barred: tuple[Action, ...] = ()
        while goal is not None or view.segmentation.instances:
            may_push = pushes < MAX_PUSHES_IN_A_ROW
            try:
                observation = _observe(view, goal, barred, place, may_push=may_push)
                action = self.policy.decide(observation)
            except NoTarget as error:
                return view, str(error)
            if observation.may_grasp:
                place = observation.goal
            view, outcome = self._act(goal, view, action)
            place = None if place is None else _whereabouts(place, action, outcome, self.cell.config)
            if observation.may_grasp:
                pushes = pushes + 1 if action.primitive is Primitive.PUSH else 0
            # A push that moved something is no failure, but only a pick is what the attempts are for; while the goal
            # is hidden, nothing else than failures ends the search.
            if outcome.result is Result.PICKED:
                failures = 0
            elif not outcome.success or not observation.may_grasp:
                failures += 1
            barred = () if outcome.result in _SCENE_CHANGED else (*barred, action)
            if outcome.result is Result.PICKED and goal is not None:
                return view, ""
            if failures >= MAX_FAILURES_IN_A_ROW:
                return (
                    view,
                    f"given up after {failures} failed attempts in a row, the last one: {outcome.detail}",
                )
        return view, ""

    def _act(self, goal: str | None, view: View, action: Action) -> tuple[View, Outcome]:
        """Run one action between its two rows of the journal; the view after it."""
        self.actions += 1
        decision = Decision(self.actions, goal, view, action)
        x, y, z = action.xyz
        action_id = self.journal.start_action(
            ActionRow(
                job_id=self.job_id,
                frame_id=self._keep_frame(view),
                goal=goal,
                primitive=action.primitive.value,
                row=action.row,
                col=action.col,
                rotation=action.rotation,
                x=x,
                y=y,
                z=z,
                q_value=action.q_value,
                started_s=self.cell.clock.now(),
            )
        )
        for observer in self.observers:
            observer.decided(decision)
        try:
            after, outcome = self._run(decision)
        except BaseException as error:
            self._end_action(action_id, decision, Outcome(Result.STOPPED, None, _describe(error), float("nan")))
            raise
        self._end_action(action_id, decision, outcome)
        return after, outcome

    def _end_action(self, action_id: int, decision: Decision, outcome: Outcome) -> None:
        self.journal.end_action(
            OutcomeRow(
                action_id=action_id,
                result=outcome.result.value,
                success=outcome.success,
                picked=outcome.picked,
                detail=outcome.detail,
                peak_force_n=outcome.peak_force_n if np.isfinite(outcome.peak_force_n) else 0.0,
                ended_s=self.cell.clock.now(),
            )
        )
        for observer in self.observers:
            observer.ended(decision, outcome)

    def _run(self, decision: Decision) -> tuple[View, Outcome]:
        cell, action = self.cell, decision.action
        try:
            plan = plan_action(action, decision.view.heightmap, cell.arm.state().q, cell.config)
            checked = check_plan(plan, cell.config)
        except UnsafeMotion as error:
            return decision.view, Outcome(Result.REFUSED, None, str(error), 0.0)
        execution = self.executor.run(checked)
        if execution.ending is not Ending.DONE:
            self._retreat()
        after = self._look()
        return after, judge(decision, after, execution)

    def _retreat(self) -> None:
        plan = plan_retreat(self.cell.arm.state(), self.cell.config)
        self.executor.run(check_plan(plan, self.cell.config))

    def _keep_frame(self, view: View) -> int:
        """Write the frame's images beside the run and note them in the journal."""
        frame, table = view.frame, view.heightmap.table
        folder = self.run_dir / "frames"
        folder.mkdir(exist_ok=True)
        color_file, depth_file = (
            folder / f"{frame.number:06d}-color.png",
            folder / f"{frame.number:06d}-depth.png",
        )
        # Depth in 1/10 mm: finer than the device's own unit, and 16 bits reach 6.5 m.
        depth = np.clip(np.round(frame.depth_m * 1e4), 0, 65535).astype(np.uint16)
        for path, image in ((color_file, frame.color[..., ::-1]), (depth_file, depth)):
            if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise DeviceFault(f"{path} cannot be written: check the disk")
        return self.journal.add_frame(
            Frame(
                job_id=self.job_id,
                number=frame.number,
                t=frame.t,
                color_file=str(color_file),
                depth_file=str(depth_file),
                coverage=view.heightmap.coverage,
                tilt_rad=table.tilt_rad if table else float("nan"),
                offset_m=table.offset_m if table else float("nan"),
            )
        )


def judge(decision: Decision, after: View, execution: Execution) -> Outcome:
    """What an action came to, by the gripper and by the heightmaps before and after it."""
    if decision.action.primitive is Primitive.PUSH:
        return _judge_push(decision, after, execution)
    return _judge_grasp(decision, after, execution)


def _judge_push(decision: Decision, after: View, execution: Execution) -> Outcome:
    changed = _changed_area(decision.view.heightmap, after.heightmap)
    result = Result.PUSHED if changed >= _MOVED_M2 else Result.NOTHING_MOVED
    return Outcome(result, None, f"{1e4 * changed:.0f} cm2 of the table changed", execution.peak_force_n)


def _judge_grasp(decision: Decision, after: View, execution: Execution) -> Outcome:
    force, width = execution.peak_force_n, f"{1000 * execution.width_m:.1f} mm"
    if execution.ending is Ending.CONTACT:
        return Outcome(Result.COLLIDED, None, f"{force:.0f} N during {execution.step!r}", force)
    if execution.ending is Ending.EMPTY:
        result = Result.MISSED if execution.step == HELD_AFTER_LIFT else Result.LOST
        return Outcome(result, None, f"the fingers were {width} apart at {execution.step!r}", force)
    taken = _taken(decision, after)
    if taken is None:
        return Outcome(Result.UNCONFIRMED, None, "something was held, but nothing is missing on the table", force)
    picked = taken.color_name
    if decision.goal is not None and picked != decision.goal:
        return Outcome(Result.WRONG_OBJECT, picked, f"took {picked} instead of {decision.goal}", force)
    return Outcome(Result.PICKED, picked, f"{picked}, held {width} wide", force)


def _observe(
    view: View,
    goal: str | None,
    barred: tuple[Action, ...],
    place: npt.NDArray[np.bool_] | None = None,
    *,
    may_push: bool,
) -> Observation:
    """What the policy is shown; `place` is where a goal may be that is not seen any more.

    Raises:
        NoTarget: the goal is not on the table, or nothing can be done to uncover it.
    """
    labels = view.segmentation.labels
    if goal is None:
        return Observation(view.heightmap, labels, None, barred, may_push)
    try:
        goal_mask = labels == find_goal(view.segmentation, goal).label
    except NoTarget:
        if place is None:
            raise
        return _uncover(view, place, barred)
    return Observation(view.heightmap, labels, goal_mask, barred, may_push)


def _uncover(view: View, place: npt.NDArray[np.bool_], barred: tuple[Action, ...]) -> Observation:
    """What the policy is shown to push aside what hides a goal.

    Raises:
        NoTarget: nothing is seen where the goal may be.
    """
    labels = view.segmentation.labels
    # What was seen of the goal need not have been all of it.
    size = 2 * round(_UNSEEN_PART_M / view.heightmap.workspace.resolution_m) + 1
    hiding = (labels > 0) & (cv2.dilate(place.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
    if not hiding.any():
        raise NoTarget("the goal is not seen any more, and nothing hides the place where it was; look for it by hand")
    return Observation(view.heightmap, labels, hiding, barred, may_push=True, may_grasp=False)


def _whereabouts(
    place: npt.NDArray[np.bool_], action: Action, outcome: Outcome, config: CellConfig
) -> npt.NDArray[np.bool_] | None:
    """(H, W) where a goal may be after an action, having been at `place`; None if it may be anywhere."""
    if outcome.result in {Result.LOST, Result.UNCONFIRMED}:
        return None
    if action.primitive is Primitive.GRASP:
        return place
    workspace = config.workspace
    # What is near its way may have gone along, as far as the push went.
    (row, col), (end_row, end_col) = (workspace.cell(*at) for at in push_segment(action, config))
    breadth = 2 * round(_STIRRED_M / workspace.resolution_m)
    stirred = cv2.line(np.zeros(place.shape, np.uint8), (col, row), (end_col, end_row), 1, breadth)
    length = round(config.motion.push_m / workspace.resolution_m)
    trace = np.zeros((2 * length + 1, 2 * length + 1), np.uint8)
    # Dilation reads the trace backwards.
    tip = (round(length * (1 - np.cos(action.theta))), round(length * (1 - np.sin(action.theta))))
    cv2.line(trace, (length, length), tip, 1)
    return np.asarray(place | (cv2.dilate(((stirred > 0) & place).astype(np.uint8), trace) > 0))


def _taken(decision: Decision, after: View) -> Instance | None:
    """The object that left the table: the one that the action was aimed at, or else the nearest that is gone."""
    before, action = decision.view, decision.action
    aimed_at = before.segmentation.labels[action.row, action.col]
    gone: list[tuple[bool, float, Instance]] = []
    for instance in before.segmentation.instances:
        x, y = instance.centroid
        distance = float(np.hypot(x - action.xyz[0], y - action.xyz[1]))
        near = instance.label == aimed_at or distance < _REACH_M
        if near and _is_gone(instance, before, after):
            gone.append((instance.label != aimed_at, distance, instance))
    return min(gone, key=lambda entry: entry[:2])[2] if gone else None


def _is_gone(instance: Instance, before: View, after: View) -> bool:
    """Whether the place where an object was is lower than before, or shows another one that fell into it."""
    known = np.isfinite(before.heightmap.height_m) & np.isfinite(after.heightmap.height_m)
    place = before.segmentation.mask(instance) & known
    sunk = before.heightmap.height_m[place] - after.heightmap.height_m[place] > _CHANGED_M
    same_color = [other.label for other in after.segmentation.instances if other.color_name == instance.color_name]
    replaced = ~np.isin(after.segmentation.labels[place], [0, *same_color])
    return bool(place.any() and (sunk | replaced).mean() >= _GONE_SHARE)


def _changed_area(before: Heightmap, after: Heightmap) -> float:
    """How much of the table [m2] is higher or lower than before, edges that flicker left out."""
    resolution = before.workspace.resolution_m
    with np.errstate(invalid="ignore"):
        changed = (np.abs(before.height_m - after.height_m) > _CHANGED_M).astype(np.uint8)
    width = max(3, round(_MOVED_WIDTH_M / resolution))
    return float(cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((width, width), np.uint8)).sum()) * resolution**2


def _describe(error: BaseException) -> str:
    if isinstance(error, CellError):
        return str(error)
    return {KeyboardInterrupt: "interrupted", SystemExit: "terminated"}.get(type(error), repr(error))


def make_run_dir(runs: Path, label: str) -> Path:
    """A new folder runs/<time>-<label>, numbered where the second does not tell two runs apart.

    Raises:
        ConfigError: it cannot be made.
    """
    stem = f"{datetime.now():%Y%m%d-%H%M%S}-{label}"
    for suffix in ("", *(f"-{n}" for n in range(2, 100))):
        path = runs / f"{stem}{suffix}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigError(f"journal.runs = {str(runs)!r}: {path} cannot be made: {error.strerror}") from error
        return path
    raise ConfigError(f"journal.runs = {str(runs)!r}: there are a hundred runs called {stem}")
