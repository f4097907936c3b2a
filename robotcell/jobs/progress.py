"""Where a job stands, by its actions and what came of them: the same while it runs and when it is resumed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from robotcell.jobs.hidden_goal import place_after
from robotcell.jobs.policy_api import PickGoal, Uncover
from robotcell.jobs.verdict import SCENE_CHANGED, Outcome, Result
from robotcell.motion.push import Push

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from robotcell.config import Workspace
    from robotcell.jobs.policy_api import Task
    from robotcell.motion.actions import Action

# Of these an attempt says nothing: it was cut off.
_CUT_OFF = frozenset({Result.UNKNOWN, Result.STOPPED})


@dataclass(frozen=True)
class Progress:
    """Where a job stands.

    Attributes:
        goals: how many of the goals are picked, in their order.
        failures: failed attempts in a row for the goal whose turn it is.
        pushes: in a row, for it.
        place: (H, W) where the goal may be if it is not seen any more; None where that is not known.
        barred: what failed on the scene as it stands.
    """

    goals: int = 0
    failures: int = 0
    pushes: int = 0
    place: npt.NDArray[np.bool_] | None = None
    barred: tuple[Action, ...] = ()

    def after(self, goal: str | None, task: Task, action: Action, outcome: Outcome, workspace: Workspace) -> Progress:
        """Where it stands after an action.

        Args:
            goal: the word of the goal that it was for; None for any object.
            task: that the action was for.
            action: that was run.
            outcome: of it.
            workspace: the map of the task's mask.
        """
        if outcome.result is Result.PICKED and goal is not None:
            return Progress(self.goals + 1)
        if outcome.result is Result.DECLINED:
            return replace(self, barred=(*self.barred, action))
        place = task.mask if isinstance(task, PickGoal) else self.place
        if place is not None:
            place = place_after(place, action, outcome.result, workspace)
        pushes, failures = self.pushes, self.failures
        if not isinstance(task, Uncover):
            pushes = pushes + 1 if isinstance(action, Push) else 0
        # A push that moved something is no failure, but only a pick is what the attempts are for; while the goal
        # is hidden, nothing else than failures ends the search.
        if outcome.result is Result.PICKED:
            failures = 0
        elif outcome.result not in _CUT_OFF and (not outcome.success or isinstance(task, Uncover)):
            failures += 1
        barred = () if outcome.result in SCENE_CHANGED else (*self.barred, action)
        return replace(self, failures=failures, pushes=pushes, place=place, barred=barred)
