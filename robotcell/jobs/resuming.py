"""What it takes to go on with a job that was cut off: whether it can be, what the gripper holds, and where it stood."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.fingers import narrowest_hold
from robotcell.errors import ConfigError, DeviceFault, NoTarget
from robotcell.jobs.journal_tables import GOAL, UNCOVER, action_of
from robotcell.jobs.ownership import Life, life
from robotcell.jobs.policy_api import PickAny, PickGoal, Uncover
from robotcell.jobs.progress import Progress
from robotcell.jobs.verdict import Outcome, Result, judge, judge_cut_off
from robotcell.motion.executor import Ending
from robotcell.motion.grasp import plan_carry
from robotcell.motion.path_check import check_path
from robotcell.motion.retreat import plan_feel
from robotcell.perception.goals import find_goal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from robotcell.cell import Cell
    from robotcell.config import Workspace
    from robotcell.io.lock_file import LockFile
    from robotcell.jobs.journal import Journal
    from robotcell.jobs.journal_tables import ActionRow, Job
    from robotcell.jobs.policy_api import Task
    from robotcell.motion.actions import Action
    from robotcell.motion.executor import Execution
    from robotcell.motion.grasp import Grasp
    from robotcell.perception.view import View


def check_resumable(job: Job, cell: Cell, policy: str, journal: Journal) -> LockFile:
    """The lock of the cell, by which the job goes on.

    Args:
        job: that is to go on.
        cell: that is open.
        policy: name of the one that will decide.
        journal: of the job.

    Raises:
        ConfigError: the job has ended, or does not belong to this cell, or is not its last one.
    """
    if job.status not in {"running", "stopped"}:
        raise ConfigError(f"job {job.id} has ended ({job.status}): start a new one with robotcell pick")
    if cell.lock is None or job.lock != cell.lock.name:
        where = "a twin that ended with its process" if (job.lock or "").startswith("process-") else str(job.lock)
        raise ConfigError(f"job {job.id} ran in another cell ({where}): start a new one with robotcell pick")
    if life(job) is Life.ELSEWHERE or (life(job) is Life.RUNNING and cell.lock.token in str(job.owner)):
        raise ConfigError(f"job {job.id} is not known to have ended: {job.owner} runs it")
    newest = journal.newest_job(cell.lock.name)
    if newest is not None and newest.id != job.id:
        raise ConfigError(f"job {newest.id} has changed the table since job {job.id}: start a new one")
    if policy != job.policy:
        raise ConfigError(f"policy.name = {policy!r}: job {job.id} was begun with {job.policy!r}; resume it with that")
    return cell.lock


def cut_off(rows: Sequence[ActionRow]) -> ActionRow | None:
    """The action of a job that was cut off: the last one, if it has no outcome or was stopped."""
    if not rows:
        return None
    outcome = rows[-1].outcome
    return rows[-1] if outcome is None or outcome.result == Result.STOPPED.value else None


def settle(cell: Cell, grasp: Grasp | None, held: Callable[[str], None] | None) -> Execution | None:
    """Go up, feel what the fingers hold, carry it into the bin, and go home.

    Args:
        cell: open.
        grasp: that was cut off; None if it was no grasp.
        held: told of the check over the bin.

    Returns:
        How the carrying ended; None if nothing was held.

    Raises:
        DeviceFault: something is held that no grasp took.
        UnsafeMotion, GuardTripped, ConnectionLost: as of every motion.
    """
    config = cell.config
    cell.executor.run(check_path(plan_feel(cell.arm.state(), config), config))
    width = cell.gripper.state().width_m
    if width < narrowest_hold(config):
        cell.home()
        return None
    if grasp is None:
        raise DeviceFault(
            f"the gripper holds something {1000 * width:.0f} mm wide that no grasp of this job took: take it out by "
            "hand, then resume",
            device="gripper",
        )
    execution = cell.executor.run(
        check_path(plan_carry(grasp, cell.arm.state().q, config), config), held or (lambda _: None)
    )
    if execution.ending is not Ending.DONE:
        cell.home()
    return execution


def judge_resumed(
    row: ActionRow, action: Action, before: View | None, after: View, execution: Execution | None
) -> Outcome:
    """What an action came to that was cut off and is settled now.

    Args:
        row: of the action.
        action: itself.
        before: what it was decided on; None if its pictures are gone.
        after: what is seen now.
        execution: of the carrying; None if nothing was held.
    """
    if execution is None:
        outcome = judge_cut_off(action, row.goal, before, after, row.held)
    elif before is None:
        detail = "something was held, and the pictures of the table before are gone"
        outcome = Outcome(Result.UNCONFIRMED, None, detail, float("nan"), float("nan"))
    else:
        outcome = judge(action, row.goal, before, after, execution)
    if outcome.result is Result.UNKNOWN and row.outcome is not None:
        # Why it was stopped says more.
        return _outcome_of(row)
    return outcome


def replay(rows: Sequence[ActionRow], recorded: Callable[[ActionRow], View | None], workspace: Workspace) -> Progress:
    """Where a job stands after these actions.

    Args:
        rows: its actions that came to an end, in their order.
        recorded: what an action was decided on, from its pictures; None if they are gone.
        workspace: the map of the views.
    """
    progress = Progress()
    # Of the goal only where it was seen last counts, and a view takes time.
    seen_last = max((index for index, row in enumerate(rows) if row.task == GOAL), default=None)
    for index, row in enumerate(rows):
        action = action_of(row)
        if action is not None:
            task = task_of(row, recorded(row) if index == seen_last else None)
            progress = progress.after(row.goal, task, action, _outcome_of(row), workspace)
    return progress


def task_of(row: ActionRow, view: View | None) -> Task:
    """The task of an action; its mask is empty, or it is to pick anything, where no view shows the goal any more."""
    if row.task == UNCOVER:
        return Uncover(np.zeros((0, 0), np.bool_) if view is None else view.segmentation.objects)
    if row.task == GOAL and row.goal is not None and view is not None:
        with suppress(NoTarget):
            return PickGoal(view.segmentation.mask(find_goal(view.segmentation, row.goal)))
    return PickAny()


def _outcome_of(row: ActionRow) -> Outcome:
    outcome = row.outcome
    if outcome is None:
        return Outcome(Result.UNKNOWN, None, "cut off", float("nan"), float("nan"))
    forces = (float("nan") if force is None else force for force in (outcome.peak_force_n, outcome.grip_force_n))
    return Outcome(Result(outcome.result), outcome.picked, outcome.detail, *forces)
