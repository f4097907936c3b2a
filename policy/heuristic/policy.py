"""The geometric policy: antipodal grasps read off the heightmap, and a push where none is clear."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from policy.antipodal import antipodal_grasps
from policy.barred import repeats_grasp
from policy.finger_clearance import OpenGripper, pad_maps
from policy.map_grid import cell_centers, check_resolution, workspace_at
from policy.push.border import USEFUL_GAIN
from policy.push.outcome import PushForwardModel
from policy.push.value import PushValue, evaluate_pushes
from policy.shadows import complete_heights
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import PickAny, Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push, push_in_workspace

if TYPE_CHECKING:
    from robotcell.config import CellConfig, Workspace
    from robotcell.jobs.policy_api import Action, Observation

# Its margins were set on cells of that size, which are about what a pixel of the camera covers at 1 m.
RESOLUTION_M = 0.002
# A grasp that scores less is worth a push first, where one is allowed.
CLEAR_GRASP = 0.30


class HeuristicPolicy:
    """Takes the best clear grasp; else, if it may, a useful push; else the best of what there is.

    Args:
        config: of the cell: gripper, camera position, table, workspace and length of a push.
    """

    name = "heuristic"

    def __init__(self, config: CellConfig) -> None:
        self._workspace = workspace_at(config.workspace, RESOLUTION_M)
        self._camera = config.camera.pose()[:3, 3]
        self._table_height_m = config.table.height_m
        self._push_m = config.motion.push_m
        self._gripper = OpenGripper.of(config)

    @property
    def workspace(self) -> Workspace:
        """That of the cell, in cells of 2 mm."""
        return self._workspace

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: no object is seen, or nothing can be done about those that are.
            ConfigError: the map is of another resolution than `workspace`.
        """
        check_resolution(observation.heightmap.workspace, self._workspace, self.name)
        targets = observation.targets()
        grasp = None if isinstance(observation.task, Uncover) else self._grasp(observation, targets)
        if grasp is not None and grasp.q_value >= CLEAR_GRASP:
            return grasp
        push = self._push(observation) if observation.may_push else None
        if push is not None and (grasp is None or push.q_value > USEFUL_GAIN):
            return push
        if grasp is not None:
            return grasp
        raise NoTarget(
            f"no grasp fits and no push {'would help' if observation.may_push else 'is allowed any more'}; "
            "rearrange the objects by hand, or choose another goal"
        )

    def _grasp(self, observation: Observation, targets: npt.NDArray[np.bool_]) -> Grasp | None:
        """The best grasp that repeats no failure."""
        heightmap = observation.heightmap
        heights = complete_heights(heightmap, self._camera, self._table_height_m)
        maps = pad_maps(heights, _owners(observation), RESOLUTION_M, self._gripper)
        found = antipodal_grasps(maps, targets, self._gripper)
        score = found.score.copy()
        x, y = cell_centers(heightmap.workspace, found.row, found.col)
        score[repeats_grasp(x, y, found.rotation, observation.barred)] = 0
        if not score.any():
            return None
        best = int(score.argmax())
        surface_m, rotation = float(found.surface_m[best]), int(found.rotation[best])
        return Grasp(float(x[best]), float(y[best]), surface_m, rotation, float(score[best]))

    def _push(self, observation: Observation) -> Push | None:
        """The best push that moves something."""
        heightmap = observation.heightmap
        model = PushForwardModel(observation.labels, heightmap)
        found = evaluate_pushes(observation, model, self._push_m, lambda cells: np.zeros(cells.shape, np.float32))
        found = [push for push in found if push.moves]
        if not found:
            return None
        best = max(found, key=_worth)
        line, workspace = best.candidate.line, heightmap.workspace
        start = workspace.position(line.row, line.col)
        return push_in_workspace(start, best.candidate.rotation, self._push_m, line.top_m, _worth(best), workspace)


def _worth(push: PushValue) -> float:
    """What a push frees of its object's border, or of what hides a goal, less what it may lose."""
    return push.gain + push.uncovered - push.loss


def _owners(observation: Observation) -> npt.NDArray[np.int32]:
    """(H, W) labels that tell what is to be grasped from its neighbours: a goal is 1, whatever else is 2."""
    if isinstance(observation.task, PickAny):
        return observation.labels
    return np.where(observation.task.mask, 1, np.where(observation.objects, 2, 0)).astype(np.int32)
