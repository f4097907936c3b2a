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

from robotcell.motion.rotations import ROTATIONS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.geometry.transforms import Array

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
        rows: (N,) of the cells.
        cols: (N,) of the cells.
        asked: (K, N) which of them each copy is made for.
        matrices: (K, 2, 3), see `turn_matrix`.
        shape: rows and columns of each copy.
    """

    rows: npt.NDArray[np.intp]
    cols: npt.NDArray[np.intp]
    asked: npt.NDArray[np.bool_]
    matrices: Array
    shape: tuple[int, int]

    @staticmethod
    def around(cells: npt.NDArray[np.bool_], rotations: Sequence[int], margin: int) -> Copies:
        """Copies that show all the cells of a mask and `margin` cells around them.

        Args:
            cells: (H, W) for all rotations, or (K, H, W) for each; some for each of them.
            rotations: the K of them.
            margin: in cells.
        """
        each = np.broadcast_to(cells, (len(rotations), *cells.shape[-2:]))
        rows, cols = np.nonzero(np.logical_or.reduce(each))
        asked = each[:, rows, cols]
        # Whole cells, here and below: so quarter turns bring cells onto cells.
        middle = (int(rows.min() + rows.max()) // 2, int(cols.min() + cols.max()) // 2)
        turns = np.stack([turn_matrix(k, middle, (0.0, 0.0)) for k in rotations])
        places = turns @ np.stack([cols, rows, np.ones(len(rows))])
        low = np.where(asked[:, None], places, np.inf).min(axis=2)
        high = np.where(asked[:, None], places, -np.inf).max(axis=2)
        center = np.rint((low + high) / 2)
        reach = np.maximum(high - center, center - low).max(axis=0) + margin
        width, height = (np.ceil(2 * reach / _MULTIPLE).astype(int) * _MULTIPLE).tolist()
        turns[:, :, 2] += np.array([width, height]) / 2 - center
        return Copies(rows, cols, asked, turns, (height, width))

    def turn(self, planes: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(K, C, rows, columns) copies of planes (C, H, W), 0 where the map does not reach.

        In memory, channels come last: that is how convolutions want them.
        """
        image, size = np.ascontiguousarray(np.moveaxis(planes, 0, 2)), self.shape[::-1]
        turned = np.empty((len(self.matrices), *self.shape, len(planes)), np.float32)
        for M, copy in zip(self.matrices, turned, strict=True):
            cv2.warpAffine(
                image, M, size, dst=copy, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0
            )
        return np.moveaxis(turned, 3, 1)

    def values(self, maps: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(K, N) of maps (K, rows, columns) at the cells; NaN where they were not asked for."""
        places = self.matrices @ np.stack([self.cols, self.rows, np.ones(len(self.rows))])
        col, row = np.rint(places).astype(np.intp).swapaxes(0, 1)
        height, width = self.shape
        found = maps[np.arange(len(maps))[:, None], row.clip(0, height - 1), col.clip(0, width - 1)]
        return np.asarray(np.where(self.asked, found, np.nan), np.float32)
