"""A board in the gripper or on the flange, as well as it is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry.transforms import Array, make_transform, transform_points
from robotcell.perception.board_plate import PLATE_M, held_by_gripper, plate_corners, size_m

if TYPE_CHECKING:
    from robotcell.config.calibration_file import CharucoBoard

# Between the points that stand for the plate; the clearance around it is of the same size.
_POINT_SPACING_M = 0.02


@dataclass(frozen=True)
class HeldBoard:
    """A board on the flange, as well as it is known.

    Attributes:
        board: its layout.
        T_flange_board: (4, 4).
    """

    board: CharucoBoard
    T_flange_board: Array

    @cached_property
    def center(self) -> Array:
        """(3,) middle of the squares in the board frame [m]."""
        return np.array([*size_m(self.board), 0.0]) / 2

    @cached_property
    def points(self) -> Array:
        """(N, 3) points all over the plate, in the frame of the flange [m]."""
        corners = plate_corners(self.board)
        low, high = corners.min(axis=0), corners.max(axis=0)
        x, y = (np.linspace(low[i], high[i], int((high[i] - low[i]) / _POINT_SPACING_M) + 2) for i in (0, 1))
        grid = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
        return np.asarray(transform_points(self.T_flange_board, grid))


def bolted_to_flange(board: CharucoBoard) -> Array:
    """T_flange_board (4, 4) of a plate bolted flat to the flange in place of the gripper, its rows along flange x."""
    width, height = size_m(board)
    return make_transform(np.diag([1.0, -1.0, -1.0]), (-width / 2, height / 2, PLATE_M))


# How T_flange_board is guessed from the layout, by what holds the board.
HOLDERS = {"gripper": held_by_gripper, "flange": bolted_to_flange}
