"""The geometric policy: antipodal grasps read off the heightmap, and a push where none is clear."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from policy.barred import repeats_grasp, repeats_push
from policy.grasp_room import Jaw, find_grasps, lay_table
from policy.heuristic.pushing import find_pushes
from policy.shadows import Surface, cell_centers, estimate_surface
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import PickAny, Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push, push_in_workspace

if TYPE_CHECKING:
    from robotcell.config import CellConfig, Workspace
    from robotcell.jobs.policy_api import Action, Observation

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
        self._workspace = config.workspace
        self._camera = config.camera.pose()[:3, 3]
        self._table_height_m = config.table.height_m
        self._push_m = config.motion.push_m
        self._jaw = Jaw(config.gripper.preshape_m, config.gripper.tip_clearance_m)

    @property
    def workspace(self) -> Workspace:
        """That of the cell."""
        return self._workspace

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: no object is seen, or nothing can be done about those that are.
        """
        targets = observation.targets()
        surface = estimate_surface(observation.heightmap, self._camera, self._table_height_m)
        grasp = None
        if not isinstance(observation.task, Uncover):
            grasp = self._best_grasp(surface, targets, observation)
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

    def _best_grasp(self, surface: Surface, targets: npt.NDArray[np.bool_], observation: Observation) -> Grasp | None:
        """The best grasp that repeats no failure."""
        workspace = observation.heightmap.workspace
        table = lay_table(surface, _owners(observation), workspace.resolution_m, self._jaw.opening_m)
        found = find_grasps(table, targets, self._jaw)
        score = found.score.copy()
        score[repeats_grasp(*cell_centers(workspace, found.row, found.col), found.rotation, observation.barred)] = 0
        if not score.any():
            return None
        best = int(score.argmax())
        x, y = workspace.position(int(found.row[best]), int(found.col[best]))
        return Grasp(x, y, float(found.surface_m[best]), int(found.rotation[best]), float(score[best]))

    def _best_push(self, surface: Surface, observation: Observation) -> Push | None:
        """The best push that repeats no failure."""
        workspace = observation.heightmap.workspace
        goal = None if isinstance(observation.task, PickAny) else 1
        found = find_pushes(surface, _instances(observation), goal, workspace, self._push_m)
        score = found.score.copy()
        score[repeats_push(*cell_centers(workspace, found.row, found.col), found.rotation, observation.barred)] = 0
        if not score.any():
            return None
        best = int(score.argmax())
        start = workspace.position(int(found.row[best]), int(found.col[best]))
        top_m, value = float(found.surface_m[best]), float(score[best])
        return push_in_workspace(start, int(found.rotation[best]), self._push_m, top_m, value, workspace)


def _owners(observation: Observation) -> npt.NDArray[np.int32]:
    """(H, W) labels that tell what is to be grasped from its neighbours: a goal is 1, whatever else is 2."""
    if isinstance(observation.task, PickAny):
        return observation.labels
    return np.where(observation.task.mask, 1, np.where(observation.objects, 2, 0)).astype(np.int32)


def _instances(observation: Observation) -> npt.NDArray[np.int32]:
    """(H, W) labels of the objects; a goal is 1."""
    labels = observation.labels
    if isinstance(observation.task, PickAny):
        return labels
    return np.where(observation.task.mask, 1, np.where(labels > 0, labels + 1, 0)).astype(np.int32)
