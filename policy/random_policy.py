"""The baseline that looks only at where objects are: a uniformly random action on or beside one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from policy.barred import repeats
from policy.grasp_room import DIRECTIONS
from policy.shadows import cell_centers, estimate_surface
from robotcell.errors import NoTarget
from robotcell.motion.rotations import ROTATIONS
from robotcell.jobs.policy_api import Action, Primitive

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.jobs.policy_api import Observation

# A push starts this near to its target (paper: its mask for pushes is dilated by 15 cells of 2 mm).
_BESIDE_M = 0.030
_SEED = 0


class RandomPolicy:
    """Tosses a coin for the primitive where a push is allowed, then draws a cell and a rotation uniformly.

    A grasp is at a cell of the goal, or of any object where there is no goal; a push starts within 30 mm of one, where
    no object is, at the height of the highest target cell within that distance. Where one primitive has nothing left
    that did not fail, it takes the other. The generator is seeded with 0 at construction and advances with each
    decision, so a policy gives the same actions for the same observations.

    Args:
        config: of the cell: camera position and table.
    """

    name = "random"

    def __init__(self, config: CellConfig) -> None:
        self._camera = config.camera.pose()[:3, 3]
        self._table_height_m = config.table.height_m
        self._generator = np.random.default_rng(_SEED)

    def decide(self, observation: Observation) -> Action:
        """Any action that did not fail yet; its `q_value` is 0.

        Raises:
            NoTarget: no object is seen, or every action on those that are has failed.
        """
        targets = observation.targets()
        heights = estimate_surface(observation.heightmap, self._camera, self._table_height_m).height_m
        allowed = {Primitive.GRASP: observation.may_grasp, Primitive.PUSH: observation.may_push}
        order = [primitive for primitive in Primitive if allowed[primitive]]
        self._generator.shuffle(order)
        for primitive in order:
            action = self._draw(primitive, targets, heights, observation)
            if action is not None:
                return action
        raise NoTarget(
            f"every grasp{' and every push' if observation.may_push else ''} has failed; "
            "rearrange the objects by hand, or choose another goal"
        )

    def _draw(
        self,
        primitive: Primitive,
        targets: npt.NDArray[np.bool_],
        heights: npt.NDArray[np.float32],
        observation: Observation,
    ) -> Action | None:
        """An action of that primitive that repeats no failure."""
        workspace = observation.heightmap.workspace
        if primitive is Primitive.GRASP:
            cells, rotations = targets, DIRECTIONS
        else:
            reach = 2 * round(_BESIDE_M / workspace.resolution_m) + 1
            square = np.ones((reach, reach), np.uint8)
            heights = np.asarray(cv2.dilate(np.where(targets, heights, np.float32(0)), square), np.float32)
            cells, rotations = (cv2.dilate(targets.astype(np.uint8), square) > 0) & ~observation.objects, ROTATIONS
        rows, cols = np.nonzero(cells)
        x, y = cell_centers(workspace, rows, cols)
        failed = repeats(primitive, x[:, None], y[:, None], np.arange(rotations), observation.barred)
        choices = np.flatnonzero(~failed)
        if not len(choices):
            return None
        cell, rotation = divmod(int(self._generator.choice(choices)), rotations)
        row, col = int(rows[cell]), int(cols[cell])
        xyz = (*workspace.position(row, col), self._table_height_m + float(heights[row, col]))
        return Action(primitive, row, col, rotation, xyz, 0.0)
