"""The geometric policy: antipodal grasps read off the heightmap, and a push where none is clear."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from policy.barred import repeats
from policy.grasp_room import Grasps, Jaw, find_grasps, lay_table
from policy.heuristic.pushing import Pushes, find_pushes
from policy.shadows import Surface, cell_centers, estimate_surface
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Action, Primitive

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.jobs.policy_api import Observation

# A grasp that scores less is worth a push first, where one is allowed.
CLEAR_GRASP = 0.30
# A push must promise at least this much (the paper's tau, a gain of a tenth of the goal's border).
USEFUL_PUSH = 0.10


class HeuristicPolicy:
    """Takes the best clear grasp; else, if it may, a useful push; else the best of what there is.

    Args:
        config: of the cell: gripper, camera position, table, workspace and length of a push.
    """

    name = "heuristic"

    def __init__(self, config: CellConfig) -> None:
        self._camera = config.camera.pose()[:3, 3]
        self._table_height_m = config.table.height_m
        self._push_m = config.motion.push_m
        self._jaw = Jaw(config.gripper.preshape_m, config.gripper.tip_clearance_m)

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: no object is seen, or nothing can be done about those that are.
        """
        targets = observation.targets()
        heightmap = observation.heightmap
        surface = estimate_surface(heightmap, self._camera, self._table_height_m)
        grasp = None
        if observation.may_grasp:
            table = lay_table(surface, _owners(observation), heightmap.workspace.resolution_m, self._jaw.opening_m)
            grasp = self._best(Primitive.GRASP, find_grasps(table, targets, self._jaw), observation)
        if grasp is not None and grasp.q_value >= CLEAR_GRASP:
            return grasp
        push = self._best_push(surface, observation) if observation.may_push else None
        if push is not None and (grasp is None or push.q_value >= USEFUL_PUSH):
            return push
        if grasp is not None:
            return grasp
        raise NoTarget(
            f"no grasp fits and no push {'would help' if observation.may_push else 'is allowed any more'}; "
            "rearrange the objects by hand, or choose another goal"
        )

    def _best(self, primitive: Primitive, found: Grasps | Pushes, observation: Observation) -> Action | None:
        """The best of what was found that repeats no failure."""
        score = found.score.copy()
        workspace = observation.heightmap.workspace
        x, y = cell_centers(workspace, found.row, found.col)
        score[repeats(primitive, x, y, found.rotation, observation.barred)] = 0
        if not score.any():
            return None
        best = int(score.argmax())
        row, col = int(found.row[best]), int(found.col[best])
        xyz = (*workspace.position(row, col), self._table_height_m + float(found.surface_m[best]))
        return Action(primitive, row, col, int(found.rotation[best]), xyz, float(score[best]))

    def _best_push(self, surface: Surface, observation: Observation) -> Action | None:
        goal = None if observation.goal is None else 1
        pushes = find_pushes(surface, _instances(observation), goal, observation.heightmap.workspace, self._push_m)
        return self._best(Primitive.PUSH, pushes, observation)


def _owners(observation: Observation) -> npt.NDArray[np.int32]:
    """(H, W) labels that tell what is to be grasped from its neighbours: a goal is 1, whatever else is 2."""
    if observation.goal is None:
        return _instances(observation)
    return np.where(observation.goal, 1, np.where(observation.objects, 2, 0)).astype(np.int32)


def _instances(observation: Observation) -> npt.NDArray[np.int32]:
    """(H, W) labels of the objects; a goal is 1."""
    labels = observation.labels
    if observation.goal is None:
        return labels
    return np.where(observation.goal, 1, np.where(labels > 0, labels + 1, 0)).astype(np.int32)
