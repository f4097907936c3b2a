"""The plate with the calibration board: its layout, how the gripper holds it, and its picture.

The default is 7 x 5 squares of 30 mm, 210 x 150 mm on an A4 page. At 0.8 m a D415 at 1280x720 sees such a square as
35 px and a bit of a marker as 4 px (2.7 px at 640x480); that is what the small dictionary of 4 x 4 bits is for. Markers
leave 9 mm between neighbours, so that the window in which a corner is refined holds the corner alone.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.config.calibration_file import CharucoBoard
from robotcell.errors import ConfigError
from robotcell.geometry import rg2
from robotcell.geometry.transforms import Array, make_transform

Bytes = npt.NDArray[np.uint8]

DEFAULT_BOARD = CharucoBoard(squares_x=7, squares_y=5, square_m=0.030, marker_m=0.021, dictionary="DICT_4X4_50")
# White around the squares: the outermost markers need it.
MARGIN_M = 0.010
# Aluminium composite sheet, as sign makers use it: flat, and stiff enough at this size.
PLATE_M = 0.004
# The fingers hold a tab at the middle of the bottom edge, so long and so wide; their tips stay this far from the plate.
TAB_M = (0.020, 0.030)
_GAP_M = 0.005


def opencv_board(board: CharucoBoard) -> cv2.aruco.CharucoBoard:
    """The same board as OpenCV has it.

    Raises:
        ConfigError: there is no such dictionary, or it has too few markers.
    """
    number = getattr(cv2.aruco, board.dictionary, None)
    if not isinstance(number, int):
        raise ConfigError(f"board: OpenCV has no dictionary {board.dictionary}; DICT_4X4_50 is one")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    needed, there = board.squares_x * board.squares_y // 2, len(dictionary.bytesList)
    if needed > there:
        raise ConfigError(
            f"board: {board.squares_x} x {board.squares_y} squares need {needed} markers and {board.dictionary} has "
            f"{there}; use fewer squares or a larger dictionary"
        )
    return cv2.aruco.CharucoBoard((board.squares_x, board.squares_y), board.square_m, board.marker_m, dictionary)


def size_m(board: CharucoBoard) -> tuple[float, float]:
    """Width and height of the squares [m], without the white margin."""
    return board.squares_x * board.square_m, board.squares_y * board.square_m


def plate_corners(board: CharucoBoard) -> Array:
    """(4, 3) corners of the plate in the board frame [m]: top left, top right, bottom right, bottom left."""
    width, height = size_m(board)
    x0, y0, x1, y1 = -MARGIN_M, -MARGIN_M, width + MARGIN_M, height + MARGIN_M
    return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])


def held_by_gripper(board: CharucoBoard) -> Array:
    """T_flange_board (4, 4) as the gripper should hold the plate: by its tab, printed side away from the flange's +x.

    The plate lies in the plane of the approach axis, its bottom edge next to the finger tips and its rows across. The
    solver finds the true value; this one plans the poses, and may be off by a centimetre and some degrees.
    """
    width, height = size_m(board)
    R = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    return make_transform(R, (-PLATE_M / 2, width / 2, rg2.CLOSED_LENGTH_M + _GAP_M + MARGIN_M + height))


def draw_plate(board: CharucoBoard, px_per_mm: int) -> Bytes:
    """The plate with its white margin (h, w) uint8, at so many pixels per millimetre.

    Raises:
        ConfigError: as `opencv_board`.
    """
    width, height = (round(1000 * side * px_per_mm) for side in size_m(board))
    margin = round(1000 * MARGIN_M * px_per_mm)
    squares = opencv_board(board).generateImage((width, height))
    return np.pad(np.asarray(squares, np.uint8), margin, constant_values=255)
