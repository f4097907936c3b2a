"""Pick-goal and pick-all: look, decide, plan, check, run, judge, until the request is met or given up.

A job is the loop around that line. What it did is in the journal; whoever wants to follow it is an observer.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from robotcell.errors import CellError, NoTarget, StorageError, UnsafeMotion
from robotcell.io.atomic_file import make_folder
from robotcell.jobs.choice import Choice, choose, task_for
from robotcell.jobs.decision import Confirm, Decision, Hold, Observer
from robotcell.jobs.journal_tables import action_of, action_row, frame_row, outcome_row
from robotcell.jobs.look_ahead import LookAhead
from robotcell.jobs.policy_api import Observation
from robotcell.jobs.preflight import preflight
from robotcell.jobs.progress import Progress
from robotcell.jobs.resuming import check_resumable, cut_off, judge_resumed, replay, settle, task_of
from robotcell.jobs.run_folder import load_frame, make_run_dir, save_frame
from robotcell.jobs.verdict import Outcome, Result, judge
from robotcell.motion.config_check import check_config
from robotcell.motion.executor import Ending, Execution
from robotcell.motion.grasp import Grasp
from robotcell.motion.retreat import at_home
from robotcell.motion.way import plan_way
from robotcell.perception.view import view_blocked, view_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from robotcell.cell import Cell
    from robotcell.jobs.journal import Journal, Metrics
    from robotcell.jobs.journal_tables import ActionRow
    from robotcell.jobs.policy_api import Policy
    from robotcell.jobs.preflight import Preflight
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.view import View

# Paper, "Evaluation": 10 consecutive failed attempts end a run.
MAX_FAILURES_IN_A_ROW = 10
# Exit codes of commands that a signal ends, in words.
_ENDED_BY = {129: "the terminal was closed", 143: "terminated"}


@dataclass(frozen=True)
class Report:
    """How a job ended; `reason` says why one that is not complete was given up."""

    job_id: int
    run_dir: Path
    completed: bool
    reason: str
    metrics: Metrics
    cell_s: float


def preview(cell: Cell, policy: Policy, goal: str | None) -> tuple[Decision, CheckedPlan | UnsafeMotion]:
    """Look, decide, plan and check one action; nothing moves. A plan that is refused comes as the refusal.

    Raises:
        ConfigError, NoTarget: as in a job.
        ConnectionLost, DeviceFault, CalibrationError: as `Cell.look`.
    """
    check_config(cell.config)
    view = cell.look(policy.workspace)
    task = task_for(view, goal, None)
    action = policy.decide(Observation(view.heightmap, view.segmentation.labels, task))
    decision = Decision(1, goal, view, task, action)
    try:
        return decision, plan_way(action, view.heightmap, view.clearance, cell.arm.state().q, cell.config)
    except UnsafeMotion as refusal:
        return decision, refusal


def run_job(
    cell: Cell,
    policy: Policy,
    journal: Journal,
    goals: tuple[str, ...] | None,
    observers: tuple[Observer, ...] = (),
    hold: Hold | None = None,
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
        hold: asked before each action; see `Hold`.
        confirm: asked before each action; None runs them all.

    Raises:
        ConfigError: the configuration does not fit together.
        CellError: the preflight found something wrong, and nothing moved; the journal has the job as refused, and
            `preflight.json` in its folder all findings.
        StorageError: the folder of the run, an image or the journal cannot be written.
        DeviceFault, ConnectionLost, GuardTripped, CalibrationError, UnsafeMotion: the cell was stopped. The journal
            has it; after a motion was cut short, the cell's latch holds until `Cell.recover`.
    """
    check_config(cell.config)
    began = cell.clock.now()
    checked = preflight(cell, journal, policy.workspace)
    # A database URL may hold a password.
    settings = cell.config.model_dump(mode="json", exclude={"journal": {"url"}})
    try:
        run_dir = make_run_dir(cell.config.journal.runs, "-".join(goals) if goals else "all")
        job_id = journal.start_job(goals, policy.name, settings, run_dir, cell.lock)
    except StorageError as error:
        # What the preflight found says this too, and whatever else is wrong.
        raise checked.refusal() or error from None
    job = _Job(cell, policy, journal, observers, hold, confirm, job_id, run_dir, goals, began)
    return job.run(checked, lambda: job.start(checked.view))


def resume_job(
    cell: Cell,
    policy: Policy,
    journal: Journal,
    job_id: int,
    observers: tuple[Observer, ...] = (),
    hold: Hold | None = None,
    confirm: Confirm | None = None,
) -> Report:
    """Go on with a job that was killed or stopped, whenever that was.

    What the gripper holds is carried on into the bin. The table is looked at, and the action that was cut off is closed
    with what can be told of it: what lies in the bin is counted once, whenever the job was cut off.

    Args:
        cell: in which the job ran; open, by `robotcell.open_cell`.
        policy: that decided.
        journal: of the job.
        job_id: number of the job, the last one of this cell.
        observers: follow it.
        hold: asked before each action; see `Hold`.
        confirm: asked before each action; None runs them all.

    Raises:
        ConfigError: the job cannot be resumed here.
        CellError: the preflight found something wrong, and nothing moved.
        DeviceFault: the gripper holds something that the job did not take.
        StorageError, ConnectionLost, GuardTripped, CalibrationError, UnsafeMotion: as `run_job`.
    """
    check_config(cell.config)
    row = journal.job(job_id)
    lock = check_resumable(row, cell, policy.name, journal)
    run_dir = Path(row.run_dir)
    make_folder(run_dir)
    began = cell.clock.now() - (row.cell_s or 0.0)
    checked = preflight(cell, journal, policy.workspace)
    refusal = checked.refusal()
    if refusal is not None:
        # It stays what it was: a job that can be resumed.
        raise refusal
    journal.resume_job(job_id, lock)
    goals = tuple(row.goals) if row.goals else None
    job = _Job(cell, policy, journal, observers, hold, confirm, job_id, run_dir, goals, began, len(row.actions))
    return job.run(checked, lambda: job.pick_up(row.actions))


@dataclass(frozen=True)
class _Ahead:
    """What was thought out while an action still ran: its result, as far as the camera tells, and what is next then."""

    result: Result
    choice: Choice | NoTarget | None


@dataclass
class _Job:
    cell: Cell
    policy: Policy
    journal: Journal
    observers: tuple[Observer, ...]
    hold: Hold | None
    confirm: Confirm | None
    job_id: int
    run_dir: Path
    goals: tuple[str, ...] | None
    # On the cell's clock [s].
    began: float
    actions: int = 0
    progress: Progress = field(default_factory=Progress)

    def run(self, checked: Preflight, start: Callable[[], View]) -> Report:
        """Start or pick up the job, and work until it ends; how it ended is on record."""
        status = "stopped"
        try:
            for observer in self.observers:
                observer.started(self.job_id, self.run_dir)
                observer.checked(checked.findings)
            checked.save(self.run_dir)
            refusal = checked.refusal()
            if refusal is not None:
                status = "refused"
                raise refusal
            with self.cell.recorder.into(self.run_dir):
                reason = self.work(start())
                self.go_home()
        except BaseException as error:
            # What stopped the job says more than a journal that cannot be told of it.
            with suppress(StorageError):
                self.journal.end_job(self.job_id, status, _describe(error), self.cell_s())
            raise
        self.journal.end_job(self.job_id, "incomplete" if reason else "complete", reason, self.cell_s())
        return Report(self.job_id, self.run_dir, not reason, reason, self.journal.metrics(self.job_id), self.cell_s())

    def cell_s(self) -> float:
        """How long the job has taken, on the cell's clock [s]."""
        return self.cell.clock.now() - self.began

    def start(self, seen: View | None) -> View:
        """Go home from wherever the arm stands, and look, unless the arm is there and `seen` is of now."""
        if seen is not None and at_home(self.cell.arm.state(), self.cell.config):
            return self._seen(seen)
        self.go_home()
        return self._look()

    def go_home(self) -> None:
        """Go home, unless the arm is there."""
        if not at_home(self.cell.arm.state(), self.cell.config):
            self.cell.home()

    def pick_up(self, rows: Sequence[ActionRow]) -> View:
        """Settle what was cut off, look, and be where the job was."""
        last = cut_off(rows)
        action = action_of(last) if last else None
        execution = None
        if last is not None or not at_home(self.cell.arm.state(), self.cell.config):
            note = (lambda label: self.journal.held(last.id, label)) if last else None
            execution = settle(self.cell, action if isinstance(action, Grasp) else None, note)
        after = self._look()

        def recorded(row: ActionRow) -> View | None:
            frame = load_frame(row.frame, after.frame)
            return None if frame is None else view_of(frame, self.cell.config, self.policy.workspace)

        self.progress = replay([row for row in rows if row is not last], recorded, self.policy.workspace)
        if last is not None and action is not None:
            before = recorded(last)
            outcome = judge_resumed(last, action, before, after, execution)
            task = task_of(last, before)
            self._end_action(last.id, Decision(self.actions, last.goal, before or after, task, action), outcome)
            self.progress = self.progress.after(last.goal, task, action, outcome, self.policy.workspace)
        return after

    def work(self, view: View) -> str:
        """Act until everything is picked; "" or why it was given up."""
        ahead: _Ahead | None = None
        while True:
            if self.hold is not None and not self._done(view, self.progress) and self.hold():
                view, ahead = self._look(), None
            choice = self._choose(view, self.progress) if ahead is None else ahead.choice
            if choice is None:
                return ""
            if isinstance(choice, NoTarget):
                return str(choice)
            goal = self._goal(self.progress)
            view, outcome, ahead = self._act(goal, view, choice)
            workspace = view.heightmap.workspace
            self.progress = self.progress.after(goal, choice.task, choice.action, outcome, workspace)
            if self.progress.failures >= MAX_FAILURES_IN_A_ROW:
                failures = self.progress.failures
                return f"given up after {failures} failed attempts in a row, the last one: {outcome.detail}"
            if ahead is not None and ahead.result is not outcome.result:
                ahead = None

    def _done(self, view: View, progress: Progress) -> bool:
        if self.goals is None:
            return not view.segmentation.instances
        return progress.goals == len(self.goals)

    def _goal(self, progress: Progress) -> str | None:
        return None if self.goals is None else self.goals[progress.goals]

    def _choose(self, view: View, progress: Progress) -> Choice | NoTarget | None:
        """What to do next; why nothing can be done; or None where nothing is left to do."""
        if self._done(view, progress):
            return None
        return choose(self.policy, view, self._goal(progress), progress)

    def _look(self) -> View:
        if view_blocked(self.cell.devices, self.cell.config, self.policy.workspace):
            self.go_home()
        return self._seen(self.cell.look(self.policy.workspace))

    def _seen(self, view: View) -> View:
        for observer in self.observers:
            observer.looked(view)
        return view

    def _act(self, goal: str | None, view: View, choice: Choice) -> tuple[View, Outcome, _Ahead | None]:
        """Run one action between its two rows of the journal; the view after it, and what was thought out meanwhile."""
        self.actions += 1
        task, action = choice.task, choice.action
        decision = Decision(self.actions, goal, view, task, action)
        frame_id = self.journal.add_frame(
            frame_row(self.job_id, view.frame, view.heightmap, save_frame(view.frame, self.run_dir))
        )
        action_id = self.journal.start_action(
            action_row(self.job_id, frame_id, goal, task, action, self.cell.clock.now())
        )
        for observer in self.observers:
            observer.decided(decision)
        try:
            after, outcome, ahead = self._run(action_id, decision)
        except BaseException as error:
            stopped = Outcome(Result.STOPPED, None, _describe(error), float("nan"), float("nan"))
            # An action without an outcome is one that was cut off: the stop itself says more.
            with suppress(StorageError):
                self._end_action(action_id, decision, stopped)
            raise
        self._end_action(action_id, decision, outcome)
        return after, outcome, ahead

    def _end_action(self, action_id: int, decision: Decision, outcome: Outcome) -> None:
        try:
            self.journal.end_action(outcome_row(action_id, outcome, self.cell.clock.now()), self.cell_s())
        finally:
            # Whoever follows the job is told what was done also where it cannot be recorded.
            for observer in self.observers:
                observer.ended(decision, outcome)

    def _run(self, action_id: int, decision: Decision) -> tuple[View, Outcome, _Ahead | None]:
        cell, view = self.cell, decision.view
        was_home = at_home(cell.arm.state(), cell.config)
        try:
            checked = self._plan(decision)
        except UnsafeMotion as error:
            # Where the arm stood in the picture, it may have hidden what there is; now it stands at home.
            view = view if was_home else self._look()
            return view, Outcome(Result.REFUSED, None, str(error), 0.0, float("nan")), None
        if self.confirm is not None and not self.confirm(decision, checked):
            return view, Outcome(Result.DECLINED, None, "somebody who was asked said no", 0.0, float("nan")), None
        with LookAhead(cell, self.policy.workspace, lambda after: self._think(decision, after)) as looking:
            execution = cell.executor.run(checked, lambda label: self.journal.held(action_id, label), looking.poll)
            seen = looking.result() if execution.ending is Ending.DONE else None
        if seen is not None:
            after, ahead = self._seen(seen[0]), seen[1]
        else:
            if execution.ending is not Ending.DONE:
                cell.home(view.clearance)
            after, ahead = self._look(), None
        return after, judge(decision.action, decision.goal, view, after, execution), ahead

    def _plan(self, decision: Decision) -> CheckedPlan:
        """The plan of an action from where the arm stands; where there is none from there, from home.

        Raises:
            UnsafeMotion: there is none from home either, where the arm then stands.
        """
        cell, view = self.cell, decision.view
        while True:
            state = cell.arm.state()
            try:
                return plan_way(decision.action, view.heightmap, view.clearance, state.q, cell.config)
            except UnsafeMotion:
                if at_home(state, cell.config):
                    raise
            cell.home(view.clearance)

    def _think(self, decision: Decision, view: View) -> _Ahead:
        """What is next, if the action under way ends as planned. Runs beside the motion and touches no device."""
        as_planned = Execution(Ending.DONE, "", 0.0, float("nan"), float("nan"))
        outcome = judge(decision.action, decision.goal, decision.view, view, as_planned)
        workspace = view.heightmap.workspace
        progress = self.progress.after(decision.goal, decision.task, decision.action, outcome, workspace)
        given_up = progress.failures >= MAX_FAILURES_IN_A_ROW
        return _Ahead(outcome.result, None if given_up else self._choose(view, progress))


def _describe(error: BaseException) -> str:
    if isinstance(error, CellError):
        return str(error)
    if isinstance(error, SystemExit):
        return _ENDED_BY.get(error.code, "terminated") if isinstance(error.code, int) else "terminated"
    return "interrupted" if isinstance(error, KeyboardInterrupt) else repr(error)
