"""The learned policy: the network's Q maps, the masks that select from them, and the rule that says when to push."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from policy.barred import repeats_grasp
from policy.finger_clearance import OpenGripper, finger_clearance, finger_reach_m, pad_maps
from policy.learned.graspability import Graspability
from policy.learned.selection import best_cells, check_maps, smoothed, surface_at
from policy.map_grid import cell_centers, check_resolution, workspace_at
from policy.network.encoding import GRASP, PUSH, RESOLUTION_M, encode
from policy.push.border import USEFUL_GAIN
from policy.push.outcome import PushForwardModel
from policy.push.value import PushValue, evaluate_pushes
from policy.shadows import complete_heights
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push, push_in_workspace

if TYPE_CHECKING:
    from policy.network.inference import Inference
    from robotcell.config import CellConfig, Workspace
    from robotcell.jobs.policy_api import Action, Observation

# A push may come first when the best grasp is less likely to succeed than this (paper: when the largest grasp Q inside
# the goal's mask is below a threshold).
_GRASP_THRESHOLD = 0.6
# Each grasp that failed on the scene as it stands says that the network is too sure of itself there.
_TRUST = 0.6
# So many of the best grasps are looked at for whether the fingers come down beside what stands around. The network
# has seen that as well: of powers of their clearance, no less than the one, the other told labelled grasps apart best.
_LOOKED_AT = 400
_BLOCKED = 0.05
_CLEARANCE_POWER = 0.2
# A push is worth the promise of a grasp after it, and with these weights what it frees of its object's border and its
# own Q.
_GAIN_SHARE = 0.3
_Q_SHARE = 0.1


class LearnedPolicy:
    """Takes the grasp of the largest Q, or a push first where no grasp is likely to succeed.

    Args:
        config: of the cell: table, workspace and length of a push.
        inference: the network.
        name: as the journal calls the policy.
        may_push: False never pushes.
    """

    def __init__(
        self, config: CellConfig, inference: Inference, name: str = "learned", *, may_push: bool = True
    ) -> None:
        self.name = name
        self._workspace = workspace_at(config.workspace, RESOLUTION_M)
        self._inference = inference
        self._may_push = may_push
        self._table_height_m = config.table.height_m
        self._push_m = config.motion.push_m
        self._camera = config.camera.pose()[:3, 3]
        self._gripper = OpenGripper.of(config)
        # As far from a grasp as its fingers reach.
        reach = math.ceil(finger_reach_m(self._gripper) / RESOLUTION_M)
        self._reach = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)

    @property
    def workspace(self) -> Workspace:
        """That of the cell, in the cells that the network was trained on."""
        return self._workspace

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: no object is seen, or nothing is left that did not fail.
            ConfigError: the map is of another resolution than `workspace`, or the network's maps are not finite, flat
                or empty.
        """
        check_resolution(observation.heightmap.workspace, self._workspace, self.name)
        targets = observation.targets()
        planes = encode(observation.heightmap.closed_m, observation.heightmap.color)
        may_push = observation.may_push and self._may_push
        grasp = None if isinstance(observation.task, Uncover) else self._grasp(observation, planes, targets)
        failed = sum(isinstance(action, Grasp) for action in observation.barred)
        trusted = 0.0 if grasp is None else grasp.q_value * _TRUST**failed
        if may_push and trusted < _GRASP_THRESHOLD:
            push = self._push(observation, planes, trusted if grasp is not None else None)
            if push is not None:
                return push
        if grasp is not None:
            return grasp
        raise NoTarget(
            f"every grasp{' and every push' if may_push else ''} has failed; "
            "rearrange the objects by hand, or choose another goal"
        )

    def _grasp(
        self, observation: Observation, planes: npt.NDArray[np.float32], targets: npt.NDArray[np.bool_]
    ) -> Grasp | None:
        """The best grasp that repeats no failure."""
        heightmap = observation.heightmap
        q = self._inference.maps(planes, targets, GRASP)
        check_maps(q, targets, "grasp")
        mask = _without_failed(observation, targets, len(q))
        rotation, rows, cols, values = best_cells(smoothed(q, targets, RESOLUTION_M), mask, _LOOKED_AT)
        if not len(values):
            return None
        near = cv2.dilate(targets.astype(np.uint8), self._reach) > 0
        heights = complete_heights(heightmap, self._camera, self._table_height_m, near)
        maps = pad_maps(heights, observation.labels, RESOLUTION_M, self._gripper)
        clearance = np.maximum(finger_clearance(maps, rows, cols, rotation, self._gripper), np.float32(_BLOCKED))
        values = values * clearance**_CLEARANCE_POWER
        chosen = int(values.argmax())
        row, col = int(rows[chosen]), int(cols[chosen])
        x, y = heightmap.workspace.position(row, col)
        surface_m = surface_at(heightmap.closed_m, (row, col), RESOLUTION_M)
        return Grasp(x, y, surface_m, int(rotation[chosen]), float(values[chosen]))

    def _push(self, observation: Observation, planes: npt.NDArray[np.float32], grasp_q: float | None) -> Push | None:
        """The best push, if it comes before a grasp of that value; None for no grasp."""
        heightmap = observation.heightmap
        model = PushForwardModel(observation.labels, heightmap)
        graspability = Graspability(self._inference, model, observation.labels, heightmap, self._gripper)

        def push_maps(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
            q = self._inference.maps(planes, cells, PUSH)
            check_maps(q, cells, "push")
            return q

        found = [
            (_worth(push, promise), promise, push)
            for push in evaluate_pushes(observation, model, self._push_m, push_maps)
            for promise in [_promise(push, graspability)]
        ]
        if not found:
            return None
        _, promise, best = max(found, key=lambda item: item[0])
        q = best.candidate.q
        if grasp_q is not None and best.gain <= USEFUL_GAIN and max(promise, q) <= grasp_q:
            return None
        line, rotation, workspace = best.candidate.line, best.candidate.rotation, heightmap.workspace
        start = workspace.position(line.row, line.col)
        return push_in_workspace(start, rotation, self._push_m, line.top_m, q, workspace)


def _promise(push: PushValue, graspability: Graspability) -> float:
    """What a push leads to: a grasp of its object, or cells that hide a goal no more."""
    if push.wanted is None or push.around_m is None:
        return push.uncovered
    return graspability.after(push.wanted, push.around_m)


def _worth(push: PushValue, promise: float) -> float:
    return promise + _GAIN_SHARE * push.gain + _Q_SHARE * push.candidate.q - push.loss


def _without_failed(observation: Observation, mask: npt.NDArray[np.bool_], rotations: int) -> npt.NDArray[np.bool_]:
    """(K, H, W) the cells of a mask (H, W) in every rotation, less the grasps that would repeat a failure."""
    allowed = np.broadcast_to(mask, (rotations, *mask.shape))
    if not observation.barred:
        return allowed
    rows, cols = np.nonzero(mask)
    x, y = cell_centers(observation.heightmap.workspace, rows, cols)
    failed = repeats_grasp(x[None], y[None], np.arange(rotations)[:, None], observation.barred)
    allowed = allowed.copy()
    allowed[:, rows, cols] &= ~failed
    return np.asarray(allowed, np.bool_)
