"""What a policy is given and what it answers."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from robotcell.errors import NoTarget

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from robotcell.perception.heightmap import Heightmap

# Index k is a rotation of k * 22.5 degrees about base z (paper: "16 rotations").
ROTATIONS = 16


class Primitive(str, enum.Enum):
    """The two motion primitives."""

    GRASP = "grasp"
    PUSH = "push"


@dataclass(frozen=True)
class Action:
    """A decision (x, y, z, theta, phi) of the paper.

    Attributes:
        primitive: phi.
        row, col: the cell of the heightmap that was chosen.
        rotation: k of theta = k * 22.5 degrees; a grasp closes along (cos theta, sin theta), a push moves along it.
        xyz: the surface at that cell, base frame [m].
        q_value: what the policy expects of it; comparable only within one policy.
    """

    primitive: Primitive
    row: int
    col: int
    rotation: int
    xyz: tuple[float, float, float]
    q_value: float

    @property
    def theta(self) -> float:
        """The rotation about base z [rad]."""
        return 2 * math.pi * self.rotation / ROTATIONS


@dataclass(frozen=True)
class Observation:
    """What a policy decides on.

    Attributes:
        heightmap: the table as the last frame showed it.
        labels: (H, W) int32, cells that hold an object carry its number from 1, all others 0.
        goal: (H, W) bool, cells of the goal object, or None when any object will do. Where the goal is hidden, the
            cells of what may lie on it.
        barred: actions that failed on the scene as it stands; the policy is not to repeat them.
        may_push: whether a push is allowed now.
        may_grasp: whether a grasp is; what lies on a goal is pushed aside and not picked.
    """

    heightmap: Heightmap
    labels: npt.NDArray[np.int32]
    goal: npt.NDArray[np.bool_] | None
    barred: tuple[Action, ...]
    may_push: bool
    may_grasp: bool = True

    @property
    def objects(self) -> npt.NDArray[np.bool_]:
        """(H, W) cells that hold an object."""
        return self.labels > 0

    def targets(self) -> npt.NDArray[np.bool_]:
        """(H, W) cells that an action may aim at: those of the goal, or of every object where there is no goal.

        Raises:
            NoTarget: none of them is seen.
        """
        targets = self.objects if self.goal is None else self.goal
        if not targets.any():
            what = "no object" if self.goal is None else "no cell of the goal"
            raise NoTarget(f"{what} is seen on the table; put one there, or end the job")
        return targets


class Policy(Protocol):
    """Chooses the next action."""

    @property
    def name(self) -> str:
        """As the command line and the journal call it."""
        ...

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: the policy sees no action worth trying.
        """
        ...
