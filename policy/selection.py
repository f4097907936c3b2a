"""From Q maps to an action: masks, the goal as selector, and the guards.

Paper, section "The problem": goal-agnostic Q maps are the raw ones times the objects' mask; the goal's mask selects
from them (Hadamard product), dilated for pushes; the action is the argmax.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from policy.push_line import PushLine, push_line
from robotcell.errors import ConfigError
from robotcell.perception import MIN_OBJECT_M

if TYPE_CHECKING:
    from collections.abc import Iterator

# Paper: 15 dilations of 3x3.
_DILATIONS = 15
# Cells of the push maps that are tried in the order of their value before pushing is given up.
_PUSH_TRIES = 2000
# What is pushed stays this far inside the workspace.
_RIM_M = 0.02
# A grasp is worth the mean of its neighbours, cells beside its object counting nothing: a lone peak is an error of the
# network, and at an edge the fingers slip. Standard deviation in cells.
_SMOOTH_CELLS = 1.5
# Maps whose values differ by less than this say nothing.
_FLAT = 1e-6


def check_maps(q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], name: str) -> None:
    """Refuse Q maps (K, H, W) that no action can be read from inside a mask (H, W).

    Raises:
        ConfigError: they are empty, not finite, or the same everywhere.
    """
    values = q[:, mask]
    if not values.size:
        problem = f"are empty, of shape {q.shape} with {np.count_nonzero(mask)} cells asked for"
    elif not np.isfinite(values).all():
        problem = f"hold {np.count_nonzero(~np.isfinite(values))} values that are not finite"
    elif np.ptp(values) < _FLAT:
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


def best_cells(
    q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], count: int
) -> Iterator[tuple[int, int, int, float]]:
    """(rotation, row, col, Q) of the `count` largest values inside a mask (H, W) or (K, H, W), the largest first."""
    inside = np.flatnonzero(np.broadcast_to(mask, q.shape))
    values = q.ravel()[inside]
    if len(values) > count:
        largest = np.argpartition(values, -count)[-count:]
        inside, values = inside[largest], values[largest]
    for i in np.argsort(-values, kind="stable"):
        k, row, col = np.unravel_index(inside[i], q.shape)
        yield int(k), int(row), int(col), float(values[i])


def pushes(
    q: npt.NDArray[np.float32],
    mask: npt.NDArray[np.bool_],
    height_m: npt.NDArray[np.float32],
    free: npt.NDArray[np.bool_],
    push_m: float,
    resolution_m: float,
) -> Iterator[tuple[int, float, PushLine]]:
    """Pushes through cells of a mask that have a place to begin: rotation, Q, line.

    The most valuable first of those that leave what they push in the workspace; then of the others.
    """
    others = []
    for k, row, col, value in best_cells(q, mask, _PUSH_TRIES):
        line = push_line(height_m, free, (row, col), k, push_m, resolution_m)
        if line is None:
            continue
        if _stays_inside(line, height_m, resolution_m):
            yield k, value, line
        else:
            others.append((k, value, line))
    yield from others


def _stays_inside(line: PushLine, height_m: npt.NDArray[np.float32], resolution_m: float) -> bool:
    """Whether what stands in the way of a push would still be in the workspace at its end.

    All that stands on the line, also beyond its end, is taken to be swept together in front of the fingers.
    """
    first, last = line.cells[0], line.cells[-1]
    length = max(1, len(line.cells) - 1)
    steps = np.arange(max(height_m.shape) * 2)
    ray = np.rint(first + (last - first) / length * steps[:, None]).astype(np.intp)
    inside = ((ray >= 0) & (ray < height_m.shape)).all(axis=1)
    ray = ray[: int(inside.argmin())] if not inside.all() else ray
    swept = np.count_nonzero(height_m[ray[:, 0], ray[:, 1]] > MIN_OBJECT_M)
    return bool(length + swept + _RIM_M / resolution_m <= len(ray))


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
