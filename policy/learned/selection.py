"""From Q maps to an action: masks, the goal as selector, and the guards.

Paper, section "The problem": goal-agnostic Q maps are the raw ones times the objects' mask; the goal's mask selects
from them (Hadamard product), dilated for pushes; the action is the argmax.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from policy.push.line import PushLine, normal, push_line, push_starts
from robotcell.errors import ConfigError
from robotcell.motion.rotations import ROTATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

# Paper: 15 dilations of 3x3.
_DILATIONS = 15
# Pushes are tried through cells so far apart [cells], so many of each rotation in the order of their value.
_APART = 3
_PUSH_TRIES = 400
# The Q of a push loses so much by each cell that its way passes beside the middle of what it is to free
# (`docs/explanation/experiments/push-ranking.md`).
_BESIDE = 0.015
# Pushes side by side whose ways are nearer to each other than this do much the same [cells].
_LANE = 10
# A grasp is worth the mean of its neighbours, cells beside its object counting nothing: a lone peak is an error of the
# network, and at an edge the fingers slip. Standard deviation in cells.
_SMOOTH_CELLS = 1.5
# Maps whose values differ by less than this say nothing; of fewer values than that, equal ones are no sign of it.
_FLAT, _FLAT_FROM = 1e-6, 20


def check_maps(q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], name: str) -> None:
    """Refuse Q maps (K, H, W) that no action can be read from inside a mask (H, W) or (K, H, W).

    Raises:
        ConfigError: they are empty, not finite, or the same everywhere.
    """
    values = q[np.broadcast_to(mask, q.shape)]
    if not values.size:
        problem = f"are empty, of shape {q.shape} with {np.count_nonzero(mask)} cells asked for"
    elif not np.isfinite(values).all():
        problem = f"hold {np.count_nonzero(~np.isfinite(values))} values that are not finite"
    elif values.size >= _FLAT_FROM and np.ptp(values) < _FLAT:
        problem = f"are flat, every value is {float(values.flat[0]):.4g}"
    else:
        return
    raise ConfigError(f"the network's {name} maps {problem}: its weights are broken; choose others, or train again")


def push_mask(targets: npt.NDArray[np.bool_], objects: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(H, W) cells whose pushes concern the targets: on an object, within 15 cells of them."""
    grown = cv2.dilate(targets.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=_DILATIONS) > 0
    return np.asarray(grown & objects)


def faded(q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Q maps (K, H, W) of grasps averaged over neighbours, with nothing outside of a mask (H, W)."""
    inside = np.where(mask, q, np.float32(0))
    return np.stack([cv2.GaussianBlur(plane, (0, 0), _SMOOTH_CELLS) for plane in inside])


class Cells(NamedTuple):
    """Places of Q maps and their values, each (N,)."""

    rotation: npt.NDArray[np.intp]
    row: npt.NDArray[np.intp]
    col: npt.NDArray[np.intp]
    q: npt.NDArray[np.float32]


def best_cells(q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], count: int) -> Cells:
    """The `count` largest values of Q maps (K, H, W) inside a mask (H, W) or (K, H, W), the largest first."""
    inside = np.flatnonzero(np.broadcast_to(mask, q.shape))
    values = q.ravel()[inside]
    if len(values) > count:
        largest = np.argpartition(values, -count)[-count:]
        inside, values = inside[largest], values[largest]
    order = np.argsort(-values, kind="stable")
    rotation, row, col = np.unravel_index(inside[order], q.shape)
    return Cells(rotation, row, col, values[order])


def thinned(mask: npt.NDArray[np.bool_], apart: int) -> npt.NDArray[np.bool_]:
    """Every so many-th row and column of a mask (H, W); all of it where none of these is in it."""
    lattice = np.zeros_like(mask)
    lattice[::apart, ::apart] = mask[::apart, ::apart]
    return lattice if lattice.any() else mask


def possible_pushes(
    mask: npt.NDArray[np.bool_],
    middle: npt.NDArray[np.float64],
    free: npt.NDArray[np.bool_],
    push_m: float,
    resolution_m: float,
    beside: float,
) -> npt.NDArray[np.bool_]:
    """(K, H, W) cells, some apart, through which pushes can be made near the middle of what they are to free.

    Args:
        mask: (H, W) cells that may be pushed through.
        middle: (H, W, 2) row and column of the middle of what a push through the cell is to free.
        free: (H, W) cells where the fingers may come down.
        push_m: length of a push.
        resolution_m: size of a cell.
        beside: no farther beside the middle than this [cells], or this farther than the nearest that can begin.
    """
    cells = np.argwhere(thinned(mask, _APART))
    away = cells - middle[cells[:, 0], cells[:, 1]]
    possible = np.zeros((ROTATIONS, *mask.shape), np.bool_)
    for k in range(ROTATIONS):
        aside = np.abs(away @ normal(k))
        for near in (aside <= beside, aside > beside):
            some = cells[near]
            begins = push_starts(free, some, k, push_m, resolution_m)[:, 0] >= 0
            if begins.any():
                begins &= aside[near] <= aside[near][begins].min() + beside
                possible[k, some[begins, 0], some[begins, 1]] = True
                break
    return possible


class Candidate(NamedTuple):
    """A push that may be chosen: rotation, cell of the push map, its Q, and the way of the fingers."""

    rotation: int
    cell: tuple[int, int]
    q: float
    line: PushLine


def middles(labels: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """(H, W, 2) row and column of the middle of the object in each cell of labels (H, W)."""
    flat = labels.ravel()
    cells = np.maximum(np.bincount(flat), 1)
    rows, cols = np.indices(labels.shape)
    middle = [(np.bincount(flat, places.ravel()) / cells)[labels] for places in (rows, cols)]
    return np.stack(middle, axis=-1)


def pushes(
    q: npt.NDArray[np.float32],
    possible: npt.NDArray[np.bool_],
    middle: npt.NDArray[np.float64],
    height_m: npt.NDArray[np.float32],
    free: npt.NDArray[np.bool_],
    push_m: float,
    resolution_m: float,
    lanes: int,
) -> Iterator[Candidate]:
    """Of each rotation, the best of the pushes that are possible, side by side.

    Args:
        q: (K, H, W) Q maps.
        possible: (K, H, W) cells that pushes are made through, see `possible_pushes`.
        middle: (H, W, 2) row and column of the middle of what a push through the cell is to free.
        height_m: (H, W) with closed gaps.
        free: (H, W) cells where the fingers may come down.
        push_m: length of a push.
        resolution_m: size of a cell.
        lanes: at most so many of a rotation.
    """
    cells = np.argwhere(np.logical_or.reduce(possible))
    values, allowed = q[:, cells[:, 0], cells[:, 1]], possible[:, cells[:, 0], cells[:, 1]]
    beside = cells - middle[cells[:, 0], cells[:, 1]]
    for k in range(len(q)):
        aside = beside @ normal(k)
        order = np.argsort(_BESIDE * np.abs(aside) - values[k], kind="stable")
        order = order[allowed[k, order]][:_PUSH_TRIES]
        taken: set[int] = set()
        for i in order.tolist():
            if (lane := round(aside[i] / _LANE)) in taken:
                continue
            cell = (int(cells[i, 0]), int(cells[i, 1]))
            line = push_line(height_m, free, cell, k, push_m, resolution_m)
            if line is None:
                continue
            yield Candidate(k, cell, float(values[k, i]), line)
            taken.add(lane)
            if len(taken) == lanes:
                break


def surface_at(height_m: npt.NDArray[np.float32], cell: tuple[int, int]) -> float:
    """Height [m] of the surface at a cell: the median of 5 x 5, unknown cells left out.

    Args:
        height_m: (H, W) with closed gaps, NaN = unknown.
        cell: row and column.
    """
    row, col = cell
    around = height_m[max(0, row - 2) : row + 3, max(0, col - 2) : col + 3]
    known = around[np.isfinite(around)]
    return float(np.median(known)) if known.size else 0.0
