"""From Q maps to grasps: masks, the goal as selector, and the guards.

Paper, section "The problem": goal-agnostic Q maps are the raw ones times the objects' mask; the goal's mask selects
from them (Hadamard product); the action is the argmax.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.errors import ConfigError

# A grasp is worth the mean of its neighbours, cells beside its object counting nothing: a lone peak is an error of the
# network, and at an edge the fingers slip. Standard deviation.
_SMOOTH_M = 0.003
# Maps whose values differ by less than this say nothing; of fewer values than that, equal ones are no sign of it.
_FLAT, _FLAT_FROM = 1e-6, 20
# The surface at a cell is taken from all cells so far around it.
_SURFACE_M = 0.004


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


def smoothed(q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], resolution_m: float) -> npt.NDArray[np.float32]:
    """Q maps (K, H, W) of grasps averaged over neighbours, with 0 outside of a mask (H, W)."""
    inside = np.where(mask, q, np.float32(0))
    return np.stack([cv2.GaussianBlur(plane, (0, 0), _SMOOTH_M / resolution_m) for plane in inside])


class QCells(NamedTuple):
    """Places of Q maps and their values, each (N,)."""

    rotation: npt.NDArray[np.intp]
    row: npt.NDArray[np.intp]
    col: npt.NDArray[np.intp]
    q: npt.NDArray[np.float32]


def best_cells(q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], count: int) -> QCells:
    """The `count` largest values of Q maps (K, H, W) inside a mask (H, W) or (K, H, W), the largest first."""
    inside = np.flatnonzero(np.broadcast_to(mask, q.shape))
    values = q.ravel()[inside]
    if len(values) > count:
        largest = np.argpartition(values, -count)[-count:]
        inside, values = inside[largest], values[largest]
    order = np.argsort(-values, kind="stable")
    rotation, row, col = np.unravel_index(inside[order], q.shape)
    return QCells(rotation, row, col, values[order])


def surface_at(height_m: npt.NDArray[np.float32], cell: tuple[int, int], resolution_m: float) -> float:
    """Height [m] of the surface at a cell: the median of what is seen within 4 mm to each side.

    Args:
        height_m: (H, W) with closed gaps, NaN = unknown.
        cell: row and column.
        resolution_m: size of a cell.
    """
    row, col = cell
    reach = round(_SURFACE_M / resolution_m)
    around = height_m[max(0, row - reach) : row + reach + 1, max(0, col - reach) : col + reach + 1]
    known = around[np.isfinite(around)]
    return float(np.median(known)) if known.size else 0.0
