"""What a policy is given and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias

from robotcell.errors import NoTarget
from robotcell.motion.actions import Action

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from robotcell.config import Workspace
    from robotcell.perception.heightmap import Heightmap

__all__ = ["Action", "Observation", "PickAny", "PickGoal", "Policy", "Task", "Uncover"]


@dataclass(frozen=True)
class PickAny:
    """Pick any object."""


@dataclass(frozen=True)
class PickGoal:
    """Pick one object; `mask` (H, W) are the cells that show it."""

    mask: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Uncover:
    """Push aside what hides a goal; `mask` (H, W) are the cells of objects that may lie on it. Grasps are no answer."""

    mask: npt.NDArray[np.bool_]


Task: TypeAlias = PickAny | PickGoal | Uncover


@dataclass(frozen=True)
class Observation:
    """What a policy decides on.

    Attributes:
        heightmap: the table as the last frame showed it, on the map of the policy (`Policy.workspace`).
        labels: (H, W) int32, cells that hold an object carry its number from 1, all others 0.
        task: what is to be done.
        barred: actions that failed on the scene as it stands; the policy is not to repeat them.
        may_push: whether a push is allowed now.
    """

    heightmap: Heightmap
    labels: npt.NDArray[np.int32]
    task: Task
    barred: tuple[Action, ...] = ()
    may_push: bool = True

    @property
    def objects(self) -> npt.NDArray[np.bool_]:
        """(H, W) cells that hold an object."""
        return self.labels > 0

    def targets(self) -> npt.NDArray[np.bool_]:
        """(H, W) cells that an action may aim at: those of the task's mask, or of every object.

        Raises:
            NoTarget: none of them is seen.
        """
        targets = self.objects if isinstance(self.task, PickAny) else self.task.mask
        if not targets.any():
            what = "no object" if isinstance(self.task, PickAny) else "no cell of the goal"
            raise NoTarget(f"{what} is seen on the table; put one there, or end the job")
        return targets


class Policy(Protocol):
    """Chooses the next action."""

    @property
    def name(self) -> str:
        """As the command line and the journal call it."""
        ...

    @property
    def workspace(self) -> Workspace:
        """The map that it decides on: rectangle and resolution. The job builds this map for it."""
        ...

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: the policy sees no action worth trying.
        """
        ...
