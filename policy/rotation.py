"""Rotated copies of the map, in which an action runs along +x, and the way back.

The network knows one direction; the sixteen come from turning what it looks at (paper: "The 16 rotations are 16 rotated
copies of the input"). Only the surroundings of the cells that can be chosen are turned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.decision import ROTATIONS

if TYPE_CHECKING:
    from robotcell.geometry import Array

# How far around its cell a Q value depends on what stands there [cells]: the fingers' reach, and what a push meets
# first. Copies that show more tell labelled attempts apart no better (`docs/policy.md`).
MARGIN = 32
# Sides of a copy: the network halves it four times.
_MULTIPLE = 16


def turn_matrix(rotation: int, cell: tuple[float, float], place: tuple[float, float]) -> Array:
    """(2, 3): maps (column, row, 1) of the map to the copy in which direction `rotation` is +x.

    Args:
        rotation: k of k * 22.5 degrees.
        cell: (row, column) of the map that lies at `place` of the copy.
        place: (row, column) of the copy.
    """
    angle = 2 * math.pi * rotation / ROTATIONS
    cos, sin = math.cos(angle), math.sin(angle)
    linear = np.array([[cos, sin], [-sin, cos]])
    return np.column_stack([linear, np.array(place[::-1]) - linear @ np.array(cell[::-1])])


@dataclass(frozen=True)
class Copies:
    """Rotated copies around some cells of a map.

    Attributes:
        side: of each copy [cells].
        matrices: (K, 2, 3), see `turn_matrix`.
        rows: (N,) of the cells.
        cols: (N,) of the cells.
    """

    side: int
    matrices: Array
    rows: npt.NDArray[np.intp]
    cols: npt.NDArray[np.intp]

    @staticmethod
    def around(cells: npt.NDArray[np.bool_], rotations: range, margin: int) -> Copies:
        """Copies that show all the cells of a mask (H, W), which is not empty, and `margin` cells around them."""
        rows, cols = np.nonzero(cells)
        # Whole cells: so quarter turns bring cells onto cells.
        center = (int(rows.min() + rows.max()) // 2, int(cols.min() + cols.max()) // 2)
        turns = np.stack([turn_matrix(k, center, (0.0, 0.0)) for k in rotations])
        reach = np.abs(turns @ np.stack([cols, rows, np.ones(len(rows))])).max() + margin
        side = math.ceil(2 * reach / _MULTIPLE) * _MULTIPLE
        turns[:, :, 2] += side / 2
        return Copies(side, turns, rows, cols)

    def turn(self, planes: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(K, C, side, side) copies of planes (C, H, W), 0 where the map does not reach; in memory, channels come last.

        That is how convolutions want them.
        """
        image = np.ascontiguousarray(np.moveaxis(planes, 0, 2))
        size = (self.side, self.side)
        turned = np.empty((len(self.matrices), *size, len(planes)), np.float32)
        for M, copy in zip(self.matrices, turned, strict=True):
            cv2.warpAffine(
                image, M, size, dst=copy, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0
            )
        return np.moveaxis(turned, 3, 1)

    def values(self, maps: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(K, N) of maps (K, side, side) at the cells."""
        places = self.matrices @ np.stack([self.cols, self.rows, np.ones(len(self.rows))])
        col, row = np.rint(places).astype(np.intp).clip(0, self.side - 1).swapaxes(0, 1)
        values: npt.NDArray[np.float32] = maps[np.arange(len(maps))[:, None], row, col]
        return values
