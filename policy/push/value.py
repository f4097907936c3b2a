"""What pushes are good for, by the forward model: the border that they free, what they uncover, what they may lose."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from policy.barred import repeats_push
from policy.push.candidates import PushCandidate, cells_with_start, object_centers, push_candidates, pushable_cells
from policy.push.line import free_to_descend
from robotcell.jobs.policy_api import PickAny, Uncover

if TYPE_CHECKING:
    from collections.abc import Callable

    from policy.push.outcome import PushForwardModel
    from robotcell.jobs.policy_api import Observation

    # Q maps (K, H, W) of pushes at cells (K, H, W).
    PushMaps = Callable[[npt.NDArray[np.bool_]], npt.NDArray[np.float32]]

# What a push loses that may take an object out of the workspace, and one that may so lose what it is for.
_LOSS, _WANTED_LOSS = 0.3, 1.0
# Where no push near the targets has a place to start, the mask grows by the same again, up to so many times in all.
_PUSHABLE_REACHES = 3
# Pushes side by side that are predicted in each direction, and how far beside the centre of what they are to free they
# are looked for. More and anywhere where a goal is hidden, since it need not lie in the middle of what hides it.
_LANES, _LANES_TO_UNCOVER = 1, 4
_OFF_CENTER_M = 0.016


class PushValue(NamedTuple):
    """A push and what the forward model says of it.

    Attributes:
        candidate: the push.
        wanted: label of the object that it is to free; None where it is to uncover a goal.
        around_m: (h, w) heights in the window of that object afterwards; None likewise.
        gain: how much of that object's border it frees, -1..1; 0 likewise.
        uncovered: share of the cells that hide a goal on which nothing stands afterwards; 0 where none is hidden.
        loss: what may be lost, 0 for nothing.
        moves: whether anything moves.
    """

    candidate: PushCandidate
    wanted: int | None
    around_m: npt.NDArray[np.float32] | None
    gain: float
    uncovered: float
    loss: float
    moves: bool


def evaluate_pushes(
    observation: Observation, model: PushForwardModel, push_m: float, push_maps: PushMaps
) -> list[PushValue]:
    """The pushes that are worth a look, none of which repeats a failure; empty where there is none.

    Args:
        observation: what is seen, and the task.
        model: of the same view.
        push_m: length of a push.
        push_maps: asked for Q maps; these choose among pushes in the same direction.
    """
    targets, task, labels = observation.targets(), observation.task, observation.labels
    heightmap = observation.heightmap
    workspace, height_m = heightmap.workspace, heightmap.closed_m
    free = free_to_descend(height_m, workspace)
    if isinstance(task, PickAny):
        center, wanted = object_centers(labels), set()
    else:
        center = np.broadcast_to(np.argwhere(targets).mean(axis=0), (*targets.shape, 2))
        wanted = set(np.unique(labels[targets]).tolist())
    hiding = targets if isinstance(task, Uncover) else None
    lanes, off_center_m = (_LANES, _OFF_CENTER_M) if hiding is None else (_LANES_TO_UNCOVER, math.inf)
    mask = targets
    for _ in range(_PUSHABLE_REACHES):
        mask = pushable_cells(mask | targets, observation.objects, workspace.resolution_m)
        possible = cells_with_start(mask, center, free, push_m, workspace.resolution_m, off_center_m)
        if not possible.any():
            continue
        q = push_maps(possible)
        found = []
        for push in push_candidates(q, possible, center, height_m, free, push_m, workspace.resolution_m, lanes):
            x, y = (np.array([v]) for v in workspace.position(push.line.row, push.line.col))
            if not repeats_push(x, y, np.array([push.rotation]), observation.barred).any():
                found.append(_evaluate(push, wanted or {int(labels[push.cell])}, hiding, model))
        if found:
            return found
    return []


def _evaluate(
    push: PushCandidate, wanted: set[int], hiding: npt.NDArray[np.bool_] | None, model: PushForwardModel
) -> PushValue:
    """Predict a push.

    Args:
        push: to be predicted.
        wanted: labels of what it is for: one object, or those that may hide the goal.
        hiding: (H, W) cells that hide the goal, None where it is seen.
        model: of the view.
    """
    outcome = model.predict(push.line, push.rotation)
    loss = _WANTED_LOSS if outcome.lost & wanted else _LOSS if outcome.lost else 0.0
    if hiding is not None:
        uncovered = model.uncovered_share(hiding, outcome)
        return PushValue(push, None, None, 0.0, uncovered, loss, bool(outcome.moves))
    label = max(wanted)
    around_m = model.height_around(label, outcome)
    return PushValue(push, label, around_m, model.border_gain(label, around_m), 0.0, loss, bool(outcome.moves))
