"""What a job does next, given what is seen. Pure functions: they may run beside a motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotcell.errors import NoTarget
from robotcell.jobs.hidden_goal import uncover
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal, Uncover
from robotcell.perception.goals import find_goal

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from robotcell.jobs.policy_api import Action, Policy, Task
    from robotcell.jobs.progress import Progress
    from robotcell.perception.view import View

# Paper, section "The problem": at most 5 pushes in a row for one goal.
MAX_PUSHES_IN_A_ROW = 5


@dataclass(frozen=True)
class Choice:
    """What is to be done, and the action that was chosen for it."""

    task: Task
    action: Action


def choose(policy: Policy, view: View, goal: str | None, progress: Progress) -> Choice | NoTarget:
    """The next action for a goal, or with None for any object; or why there is none."""
    try:
        task = task_for(view, goal, progress.place)
        may_push = progress.pushes < MAX_PUSHES_IN_A_ROW or isinstance(task, Uncover)
        observation = Observation(view.heightmap, view.segmentation.labels, task, progress.barred, may_push)
        return Choice(task, policy.decide(observation))
    except NoTarget as error:
        return error


def task_for(view: View, goal: str | None, place: npt.NDArray[np.bool_] | None) -> Task:
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
