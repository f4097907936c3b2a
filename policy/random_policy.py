"""The baseline that looks only at where objects are: a uniformly random action on or beside one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from policy.barred import repeats_grasp, repeats_push
from policy.map_grid import cell_centers
from policy.shadows import complete_heights
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import push_in_workspace
from robotcell.motion.rotations import GRASP_ROTATIONS, ROTATIONS

if TYPE_CHECKING:
    from robotcell.config import CellConfig, Workspace
    from robotcell.jobs.policy_api import Action, Observation

# A push starts this near to its target (paper: its mask for pushes is dilated by 15 cells of 2 mm).
_BESIDE_M = 0.030
_SEED = 0


class RandomPolicy:
    """Tosses a coin for grasp or push where both are allowed, then draws a cell and a rotation uniformly.

    A grasp is at a cell of the task's mask, or of any object where the task has none; a push starts within 30 mm of
    one, where no object is, and is as high as the highest of these cells within that distance. Where one kind of
    action has nothing left that did not fail, it takes the other. The generator is seeded with 0 at construction and
    advances with each decision, so a policy gives the same actions for the same observations.

    Args:
        config: of the cell: camera position, table, workspace and length of a push.
    """

    name = "random"

    def __init__(self, config: CellConfig) -> None:
        self._workspace = config.workspace
        self._push_m = config.motion.push_m
        self._camera = config.camera.pose()[:3, 3]
        self._table_height_m = config.table.height_m
        self._generator = np.random.default_rng(_SEED)

    @property
    def workspace(self) -> Workspace:
        """That of the cell, whatever its resolution."""
        return self._workspace

    def decide(self, observation: Observation) -> Action:
        """Any action that did not fail yet; its `q_value` is 0.

        Raises:
            NoTarget: no object is seen, or every action on those that are has failed.
        """
        targets = observation.targets()
        heights = complete_heights(observation.heightmap, self._camera, self._table_height_m).height_m
        draws = [] if isinstance(observation.task, Uncover) else [self._grasp]
        if observation.may_push:
            draws.append(self._push)
        self._generator.shuffle(draws)
        for draw in draws:
            action = draw(targets, heights, observation)
            if action is not None:
                return action
        raise NoTarget(
            f"every grasp{' and every push' if observation.may_push else ''} has failed; "
            "rearrange the objects by hand, or choose another goal"
        )

    def _grasp(
        self, targets: npt.NDArray[np.bool_], heights: npt.NDArray[np.float32], observation: Observation
    ) -> Action | None:
        """A grasp of a target that repeats no failure."""
        workspace = observation.heightmap.workspace
        rows, cols = np.nonzero(targets)
        x, y = cell_centers(workspace, rows, cols)
        drawn = self._draw(repeats_grasp(x[:, None], y[:, None], np.arange(GRASP_ROTATIONS), observation.barred))
        if drawn is None:
            return None
        cell, rotation = drawn
        return Grasp(*workspace.position(rows[cell], cols[cell]), float(heights[rows[cell], cols[cell]]), rotation, 0.0)

    def _push(
        self, targets: npt.NDArray[np.bool_], heights: npt.NDArray[np.float32], observation: Observation
    ) -> Action | None:
        """A push from beside a target that repeats no failure."""
        workspace = observation.heightmap.workspace
        reach = 2 * round(_BESIDE_M / workspace.resolution_m) + 1
        square = np.ones((reach, reach), np.uint8)
        tops = cv2.dilate(np.where(targets, heights, np.float32(0)), square)
        rows, cols = np.nonzero((cv2.dilate(targets.astype(np.uint8), square) > 0) & ~observation.objects)
        x, y = cell_centers(workspace, rows, cols)
        drawn = self._draw(repeats_push(x[:, None], y[:, None], np.arange(ROTATIONS), observation.barred))
        if drawn is None:
            return None
        cell, rotation = drawn
        start = workspace.position(rows[cell], cols[cell])
        return push_in_workspace(start, rotation, self._push_m, float(tops[rows[cell], cols[cell]]), 0.0, workspace)

    def _draw(self, failed: npt.NDArray[np.bool_]) -> tuple[int, int] | None:
        """A cell and a rotation among those (N, K) that have not failed; None if all have."""
        choices = np.flatnonzero(~failed)
        if not len(choices):
            return None
        cell, rotation = divmod(int(self._generator.choice(choices)), failed.shape[1])
        return cell, rotation
