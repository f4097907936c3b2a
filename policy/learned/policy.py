"""The learned policy: the network's Q maps, the masks that select from them, and the rule that says when to push."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from policy.barred import repeats_grasp, repeats_push
from policy.grasp_room import Jaw, finger_reach, finger_room, lay_table
from policy.learned.selection import (
    Candidate,
    best_cells,
    check_maps,
    faded,
    middles,
    possible_pushes,
    push_mask,
    pushes,
    surface_at,
)
from policy.network.encoding import encode
from policy.network.q_network import GRASP, PUSH
from policy.push.line import free_to_descend
from policy.push.outcome import Foresight
from policy.push.value import Prospects
from policy.shadows import cell_centers, estimate_surface
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import PickAny, Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push, push_in_workspace

if TYPE_CHECKING:
    from policy.network.inference import Inference
    from robotcell.config import CellConfig, Workspace
    from robotcell.jobs.policy_api import Action, Observation

# A push may come first when the best grasp is less likely to succeed than this (paper: when the largest grasp Q inside
# the goal's mask is below a threshold).
_GRASP_THRESHOLD = 0.6
# Where no push near the targets has a place to begin, the mask grows by the same again, up to so many times in all.
_PUSH_REACHES = 3
# Pushes of a rotation that are played ahead, and how far beside the middle of what they are to free they are looked for
# [cells]: the network is shown the less for it. More and anywhere where a goal is hidden, since it need not lie in the
# middle of what hides it.
_LANES, _LANES_TO_SEARCH = 1, 4
_ASIDE = 8
# Each grasp that failed on the scene as it stands says that the network is too sure of itself there.
_TRUST = 0.6
# So many of the best grasps are looked at for whether the fingers come down beside what stands around. The network
# has seen that as well: of powers of their room, no less than the one, the other told labelled grasps apart best.
_LOOKED_AT = 400
_BLOCKED = 0.05
_ROOM_POWER = 0.2
# Pushes are played ahead: how well the object can be grasped then counts, and with these weights what is freed of its
# border, the push's Q, and that anything may be lost, or what is wanted.
_GAIN_SHARE = 0.3
_Q_SHARE = 0.1
_LOSS = 0.3
_WANTED_LOSS = 1.0
# A push that frees this much of the border comes before any doubtful grasp (paper: tau of the reward).
_USEFUL_GAIN = 0.1


class _Push(NamedTuple):
    """A push that was played ahead: what it frees of its object's border, what it promises, and what may be lost by it.

    What hides a goal is not to be grasped: there, the promise is the share of its cells that the push uncovers.
    """

    candidate: Candidate
    gain: float
    promise: float
    loss: float

    def worth(self) -> float:
        return self.promise + _GAIN_SHARE * self.gain + _Q_SHARE * self.candidate.q - self.loss

    def is_better_than(self, grasp: float) -> bool:
        """Whether it comes before a grasp of that value."""
        return self.gain > _USEFUL_GAIN or max(self.promise, self.candidate.q) > grasp


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
        self._workspace = config.workspace
        self._inference = inference
        self._may_push = may_push
        self._table_height_m = config.table.height_m
        self._push_m = config.motion.push_m
        self._camera = config.camera.pose()[:3, 3]
        self._jaw = Jaw(config.gripper.preshape_m, config.gripper.tip_clearance_m)
        # As far from a grasp as its fingers reach.
        reach = math.ceil(finger_reach(self._jaw.opening_m) / config.workspace.resolution_m)
        self._reach = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)

    @property
    def workspace(self) -> Workspace:
        """That of the cell."""
        return self._workspace

    def decide(self, observation: Observation) -> Action:
        """The best action.

        Raises:
            NoTarget: no object is seen, or nothing is left that did not fail.
            ConfigError: the network's maps are not finite, flat or empty.
        """
        targets = observation.targets()
        height_m = observation.heightmap.closed_m
        planes = encode(height_m, observation.heightmap.color)
        may_push = observation.may_push and self._may_push
        grasp = None
        if not isinstance(observation.task, Uncover):
            grasp = self._grasp(observation, planes, targets, height_m)
        failed = sum(isinstance(action, Grasp) for action in observation.barred)
        trusted = 0.0 if grasp is None else grasp.q_value * _TRUST**failed
        if may_push and trusted < _GRASP_THRESHOLD:
            push = self._push(observation, planes, targets, height_m)
            if push is not None and (grasp is None or push.is_better_than(trusted)):
                return self._push_action(observation, push.candidate)
        if grasp is not None:
            return grasp
        raise NoTarget(
            f"every grasp{' and every push' if may_push else ''} has failed; "
            "rearrange the objects by hand, or choose another goal"
        )

    def _grasp(
        self,
        observation: Observation,
        planes: npt.NDArray[np.float32],
        targets: npt.NDArray[np.bool_],
        height_m: npt.NDArray[np.float32],
    ) -> Grasp | None:
        q = self._inference.maps(planes, targets, GRASP)
        check_maps(q, targets, "grasp")
        mask = _allowed(observation, targets, len(q))
        rotation, rows, cols, values = best_cells(faded(q, targets), mask, _LOOKED_AT)
        if not len(values):
            return None
        heightmap = observation.heightmap
        near = cv2.dilate(targets.astype(np.uint8), self._reach) > 0
        surface = estimate_surface(heightmap, self._camera, self._table_height_m, near)
        table = lay_table(surface, observation.labels, heightmap.workspace.resolution_m, self._jaw.opening_m)
        room = np.maximum(finger_room(table, rows, cols, rotation, self._jaw), np.float32(_BLOCKED))
        values = values * room**_ROOM_POWER
        chosen = int(values.argmax())
        row, col = int(rows[chosen]), int(cols[chosen])
        x, y = heightmap.workspace.position(row, col)
        return Grasp(x, y, surface_at(height_m, (row, col)), int(rotation[chosen]), float(values[chosen]))

    def _push(
        self,
        observation: Observation,
        planes: npt.NDArray[np.float32],
        targets: npt.NDArray[np.bool_],
        height_m: npt.NDArray[np.float32],
    ) -> _Push | None:
        """The best push near the targets, or farther from them where none has a place to begin."""
        heightmap = observation.heightmap
        resolution_m = heightmap.workspace.resolution_m
        free = free_to_descend(height_m, heightmap.workspace)
        foresight = Foresight(observation.labels, heightmap)
        prospects = Prospects(self._inference, foresight, observation.labels, heightmap, self._jaw)
        task = observation.task
        if isinstance(task, PickAny):
            middle = middles(observation.labels)
        else:
            middle = np.broadcast_to(np.argwhere(targets).mean(axis=0), (*targets.shape, 2))
        # Under one of these a hidden goal is.
        wanted = set(np.unique(observation.labels[targets]).tolist()) if not isinstance(task, PickAny) else None
        lanes, beside = (_LANES_TO_SEARCH, math.inf) if isinstance(task, Uncover) else (_LANES, _ASIDE)
        hiding = targets if isinstance(task, Uncover) else None
        mask = targets
        for _ in range(_PUSH_REACHES):
            mask = push_mask(mask | targets, observation.objects)
            possible = possible_pushes(mask, middle, free, self._push_m, resolution_m, beside)
            if not possible.any():
                continue
            q = self._inference.maps(planes, possible, PUSH)
            check_maps(q, possible, "push")
            found: list[_Push] = []
            for push in pushes(q, possible, middle, height_m, free, self._push_m, resolution_m, lanes):
                x, y = (np.array([v]) for v in heightmap.workspace.position(push.line.row, push.line.col))
                if not repeats_push(x, y, np.array([push.rotation]), observation.barred).any():
                    aims = wanted or {int(observation.labels[push.cell])}
                    found.append(_play(push, aims, hiding, foresight, prospects))
            if found:
                return max(found, key=_Push.worth)
        return None

    def _push_action(self, observation: Observation, push: Candidate) -> Push:
        line, workspace = push.line, observation.heightmap.workspace
        start = workspace.position(line.row, line.col)
        return push_in_workspace(start, push.rotation, self._push_m, line.top_m, push.q, workspace)


def _play(
    push: Candidate,
    wanted: set[int],
    hiding: npt.NDArray[np.bool_] | None,
    foresight: Foresight,
    prospects: Prospects,
) -> _Push:
    """What comes of a push.

    Args:
        push: to be played.
        wanted: labels of what it is for: one object, or those that may hide the goal.
        hiding: (H, W) cells that hide the goal, None where it is seen.
        foresight: of the view.
        prospects: of the view.
    """
    played = foresight.play(push.line, push.rotation)
    if hiding is None:
        label = max(wanted)
        around = foresight.around(label, played)
        gain, promise = foresight.freed(label, around), prospects.after(label, around)
    else:
        gain, promise = 0.0, foresight.uncovered(hiding, played)
    loss = _WANTED_LOSS if played.lost & wanted else _LOSS if played.lost else 0.0
    return _Push(push, gain, promise, loss)


def _allowed(observation: Observation, mask: npt.NDArray[np.bool_], rotations: int) -> npt.NDArray[np.bool_]:
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
