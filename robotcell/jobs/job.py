"""Pick-goal and pick-all: look, decide, plan, check, run, judge, until the request is met or given up.

A job is the loop around that line. What it did is in the journal; whoever wants to follow it is an observer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import CellError, NoTarget, StorageError, UnsafeMotion
from robotcell.jobs.decision import Confirm, Decision, Observer
from robotcell.jobs.hidden_goal import place_after, uncover
from robotcell.jobs.journal_tables import action_row, frame_row, outcome_row
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal, Uncover
from robotcell.jobs.preflight import preflight
from robotcell.jobs.run_folder import make_run_dir, save_frame
from robotcell.jobs.verdict import SCENE_CHANGED, Outcome, Result, judge
from robotcell.motion.actions import plan_action
from robotcell.motion.config_check import check_config
from robotcell.motion.executor import Ending
from robotcell.motion.path_check import check_path
from robotcell.motion.push import Push
from robotcell.perception.goals import find_goal

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from robotcell.cell import Cell
    from robotcell.jobs.journal import Journal, Metrics
    from robotcell.jobs.policy_api import Policy, Task
    from robotcell.motion.actions import Action
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.view import View

# Paper, section "The problem": at most 5 pushes in a row for one goal; "Evaluation": 10 consecutive failed
# attempts end a run.
MAX_PUSHES_IN_A_ROW = 5
MAX_FAILURES_IN_A_ROW = 10
# An arm this near to the home pose is at home.
_AT_HOME_RAD = 0.01


@dataclass(frozen=True)
class Report:
    """How a job ended; `reason` says why one that is not complete was given up."""

    job_id: int
    run_dir: Path
    completed: bool
    reason: str
    metrics: Metrics
    cell_s: float


def preview(cell: Cell, policy: Policy, goal: str | None) -> tuple[Decision, CheckedPlan]:
    """Look, decide, plan and check one action; nothing moves.

    Raises:
        ConfigError, NoTarget, UnsafeMotion: as in a job.
        ConnectionLost, DeviceFault, CalibrationError: as `Cell.look`.
    """
    check_config(cell.config)
    view = cell.look(policy.workspace)
    task = _task(view, goal, None)
    action = policy.decide(_observe(view, task, (), may_push=True))
    plan = plan_action(action, view.heightmap, cell.arm.state().q, cell.config)
    return Decision(1, goal, view, task, action), check_path(plan, cell.config)


def run_job(
    cell: Cell,
    policy: Policy,
    journal: Journal,
    goals: tuple[str, ...] | None,
    observers: tuple[Observer, ...] = (),
    confirm: Confirm | None = None,
) -> Report:
    """Pick the goals (colours) in their order, or with None everything on the table.

    A goal that is not on the table when its turn comes ends the job; the report's reason lists what is there. What
    hides a goal that was seen before is pushed aside.

    Args:
        cell: open.
        policy: that decides.
        journal: of the job.
        goals: the words of the goals, in their order.
        observers: follow it.
        confirm: is asked before each action; None runs them all.

    Raises:
        ConfigError: the configuration does not fit together.
        CellError: the preflight found something wrong, and nothing moved; the journal has the job as refused, and
            `preflight.json` in its folder all findings.
        StorageError: the folder of the run, an image or the journal cannot be written.
        DeviceFault, ConnectionLost, GuardTripped, CalibrationError, UnsafeMotion: the cell was stopped. The journal
            has it; after a motion was cut short, the cell's latch holds until `Cell.recover`.
    """
    check_config(cell.config)
    checked = preflight(cell, journal, policy.workspace)
    refusal = checked.refusal()
    started = cell.clock.now()
    status, reason = "stopped", ""
    # A database URL may hold a password.
    settings = cell.config.model_dump(mode="json", exclude={"journal": {"url"}})
    try:
        run_dir = make_run_dir(cell.config.journal.runs, "-".join(goals) if goals else "all")
        checked.save(run_dir)
        job_id = journal.start_job(goals, policy.name, settings, run_dir)
    except StorageError as error:
        # What the preflight found says this too, and whatever else is wrong.
        raise refusal or error from None
    try:
        for observer in observers:
            observer.started(job_id, run_dir)
        for observer in observers:
            observer.checked(checked.findings)
        if refusal is not None:
            status = "refused"
            raise refusal
        job = _Job(cell, policy, journal, observers, confirm, job_id, run_dir, checked.view)
        with cell.recorder.into(run_dir):
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
    confirm: Confirm | None
    job_id: int
    run_dir: Path
    # What the preflight saw, to begin with.
    view: View | None = None
    actions: int = 0

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
        off = np.abs(self.cell.arm.state().q - np.array(self.cell.config.motion.home_q)).max()
        if off > _AT_HOME_RAD:
            self.cell.home()
        elif self.view is not None:
            return self._show(self.view)
        return self._look()

    def _look(self) -> View:
        return self._show(self.cell.look(self.policy.workspace))

    def _show(self, view: View) -> View:
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
            try:
                task = _task(view, goal, place)
                may_push = pushes < MAX_PUSHES_IN_A_ROW or isinstance(task, Uncover)
                action = self.policy.decide(_observe(view, task, barred, may_push=may_push))
            except NoTarget as error:
                return view, str(error)
            if isinstance(task, PickGoal):
                place = task.mask
            view, outcome = self._act(goal, view, task, action)
            if place is not None:
                place = place_after(place, action, outcome.result, view.heightmap.workspace)
            if not isinstance(task, Uncover):
                pushes = pushes + 1 if isinstance(action, Push) else 0
            # A push that moved something is no failure, but only a pick is what the attempts are for; while the goal
            # is hidden, nothing else than failures ends the search.
            if outcome.result is Result.PICKED:
                failures = 0
            elif outcome.result is not Result.DECLINED and (not outcome.success or isinstance(task, Uncover)):
                failures += 1
            barred = () if outcome.result in SCENE_CHANGED else (*barred, action)
            if outcome.result is Result.PICKED and goal is not None:
                return view, ""
            if failures >= MAX_FAILURES_IN_A_ROW:
                return view, f"given up after {failures} failed attempts in a row, the last one: {outcome.detail}"
        return view, ""

    def _act(self, goal: str | None, view: View, task: Task, action: Action) -> tuple[View, Outcome]:
        """Run one action between its two rows of the journal; the view after it."""
        self.actions += 1
        decision = Decision(self.actions, goal, view, task, action)
        frame_id = self.journal.add_frame(
            frame_row(self.job_id, view.frame, view.heightmap, save_frame(view.frame, self.run_dir))
        )
        action_id = self.journal.start_action(action_row(self.job_id, frame_id, goal, action, self.cell.clock.now()))
        for observer in self.observers:
            observer.decided(decision)
        try:
            after, outcome = self._run(decision)
        except BaseException as error:
            stopped = Outcome(Result.STOPPED, None, _describe(error), float("nan"), float("nan"))
            self._end_action(action_id, decision, stopped)
            raise
        self._end_action(action_id, decision, outcome)
        return after, outcome

    def _end_action(self, action_id: int, decision: Decision, outcome: Outcome) -> None:
        self.journal.end_action(outcome_row(action_id, outcome, self.cell.clock.now()))
        for observer in self.observers:
            observer.ended(decision, outcome)

    def _run(self, decision: Decision) -> tuple[View, Outcome]:
        cell, view = self.cell, decision.view
        try:
            plan = plan_action(decision.action, view.heightmap, cell.arm.state().q, cell.config)
            checked = check_path(plan, cell.config)
        except UnsafeMotion as error:
            return view, Outcome(Result.REFUSED, None, str(error), 0.0, float("nan"))
        if self.confirm is not None and not self.confirm(decision, checked.plan):
            return view, Outcome(Result.DECLINED, None, "somebody who was asked said no", 0.0, float("nan"))
        execution = cell.executor.run(checked)
        if execution.ending is not Ending.DONE:
            cell.home()
        after = self._look()
        return after, judge(decision.action, decision.goal, view, after, execution)


def _task(view: View, goal: str | None, place: npt.NDArray[np.bool_] | None) -> Task:
    """What is to be done next; `place` (H, W) is where a goal may be that is not seen any more.

    Raises:
        NoTarget: the goal is not on the table, or nothing can be done to uncover it.
    """
    if goal is None:
        return PickAny()
    try:
        return PickGoal(view.segmentation.mask(find_goal(view.segmentation, goal)))
    except NoTarget:
        if place is None:
            raise
        return uncover(view, place)


def _observe(view: View, task: Task, barred: tuple[Action, ...], *, may_push: bool) -> Observation:
    return Observation(view.heightmap, view.segmentation.labels, task, barred, may_push)


def _describe(error: BaseException) -> str:
    if isinstance(error, CellError):
        return str(error)
    return {KeyboardInterrupt: "interrupted", SystemExit: "terminated"}.get(type(error), repr(error))
