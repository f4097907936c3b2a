"""Which pushes are worth predicting: through cells near the targets, spread over directions and side by side.

Cells are places on objects that a push passes through (`policy.push.line`); where the fingers come down follows.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from policy.push.line import PushLine, normal, push_line, push_starts
from robotcell.motion.rotations import ROTATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

# Paper: the goal's mask is dilated 15 times by 3 x 3 cells of 2 mm.
_PUSHABLE_M = 0.030
# Pushes are tried through cells this far apart, and so many in each direction in the order of their value.
_SPACING_M = 0.006
_TRIES = 400
# The Q of a push loses so much by each metre that its way passes beside the centre of what it is to free
# (`docs/explanation/experiments/push-ranking.md`).
_OFF_CENTER_PER_M = 7.5
# Of pushes whose ways are nearer to each other than this, one is predicted: they do much the same.
_LANE_M = 0.020


class PushCandidate(NamedTuple):
    """A push that may be chosen.

    Attributes:
        rotation: index of its direction.
        cell: row and column of the place on an object that it passes through.
        q: of the push at that cell.
        line: the way of the fingers.
    """

    rotation: int
    cell: tuple[int, int]
    q: float
    line: PushLine


def pushable_cells(
    targets: npt.NDArray[np.bool_], objects: npt.NDArray[np.bool_], resolution_m: float
) -> npt.NDArray[np.bool_]:
    """(H, W) cells whose pushes concern the targets (H, W): on an object, within 30 mm of them."""
    steps = round(_PUSHABLE_M / resolution_m)
    grown = cv2.dilate(targets.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=steps) > 0
    return np.asarray(grown & objects)


def thinned(mask: npt.NDArray[np.bool_], step: int) -> npt.NDArray[np.bool_]:
    """Every so many-th row and column of a mask (H, W); all of it where none of these is in it."""
    lattice = np.zeros_like(mask)
    lattice[::step, ::step] = mask[::step, ::step]
    return lattice if lattice.any() else mask


def object_centers(labels: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """(H, W, 2) row and column of the centre of the object in each cell of labels (H, W)."""
    flat = labels.ravel()
    cells = np.maximum(np.bincount(flat), 1)
    rows, cols = np.indices(labels.shape)
    center = [(np.bincount(flat, places.ravel()) / cells)[labels] for places in (rows, cols)]
    return np.stack(center, axis=-1)


def cells_with_start(
    mask: npt.NDArray[np.bool_],
    center: npt.NDArray[np.float64],
    free: npt.NDArray[np.bool_],
    push_m: float,
    resolution_m: float,
    off_center_m: float = math.inf,
) -> npt.NDArray[np.bool_]:
    """(K, H, W) cells of a mask, some apart, through which a push in direction k has a place to start.

    Args:
        mask: (H, W) cells that may be pushed through.
        center: (H, W, 2) row and column of the centre of what a push through the cell is to free.
        free: (H, W) cells where the closed fingers may come down.
        push_m: length of a push.
        resolution_m: size of a cell.
        off_center_m: the way passes the centre no farther aside than this, or this farther than the nearest that has a
            start.
    """
    cells = np.argwhere(thinned(mask, round(_SPACING_M / resolution_m)))
    away = cells - center[cells[:, 0], cells[:, 1]]
    possible = np.zeros((ROTATIONS, *mask.shape), np.bool_)
    reach = off_center_m / resolution_m
    for k in range(ROTATIONS):
        aside = np.abs(away @ normal(k))
        for near in (aside <= reach, aside > reach):
            some = cells[near]
            begins = push_starts(free, some, k, push_m, resolution_m)[:, 0] >= 0
            if begins.any():
                begins &= aside[near] <= aside[near][begins].min() + reach
                possible[k, some[begins, 0], some[begins, 1]] = True
                break
    return possible


def push_candidates(
    q: npt.NDArray[np.float32],
    possible: npt.NDArray[np.bool_],
    center: npt.NDArray[np.float64],
    height_m: npt.NDArray[np.float32],
    free: npt.NDArray[np.bool_],
    push_m: float,
    resolution_m: float,
    lanes: int,
) -> Iterator[PushCandidate]:
    """In each direction, the best of the pushes that are possible, side by side.

    Args:
        q: (K, H, W) Q maps.
        possible: (K, H, W) cells that pushes are made through, see `cells_with_start`.
        center: (H, W, 2) row and column of the centre of what a push through the cell is to free.
        height_m: (H, W) with closed gaps.
        free: (H, W) cells where the closed fingers may come down.
        push_m: length of a push.
        resolution_m: size of a cell.
        lanes: at most so many in a direction.
    """
    cells = np.argwhere(np.logical_or.reduce(possible))
    values, allowed = q[:, cells[:, 0], cells[:, 1]], possible[:, cells[:, 0], cells[:, 1]]
    away = cells - center[cells[:, 0], cells[:, 1]]
    for k in range(len(q)):
        aside = away @ normal(k)
        order = np.argsort(_OFF_CENTER_PER_M * resolution_m * np.abs(aside) - values[k], kind="stable")
        order = order[allowed[k, order]][:_TRIES]
        taken: set[int] = set()
        for i in order.tolist():
            if (lane := round(aside[i] / (_LANE_M / resolution_m))) in taken:
                continue
            cell = (int(cells[i, 0]), int(cells[i, 1]))
            line = push_line(height_m, free, cell, k, push_m, resolution_m)
            if line is None:
                continue
            yield PushCandidate(k, cell, float(values[k, i]), line)
            taken.add(lane)
            if len(taken) == lanes:
                break
