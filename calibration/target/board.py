"""The calibration board: its layout, how it is held, its picture, and a page to print.

The default is 7 x 5 squares of 30 mm, 210 x 150 mm on an A4 page. At 0.8 m a D415 at 1280x720 sees such a square as
35 px and a bit of a marker as 4 px (2.7 px at 640x480); that is what the small dictionary of 4 x 4 bits is for. Markers
leave 9 mm between neighbours, so that the window in which a corner is refined holds the corner alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from robotcell.config.calibration_file import CharucoBoard
from robotcell.errors import ConfigError
from robotcell.geometry import rg2
from robotcell.geometry.transforms import Array, make_transform

if TYPE_CHECKING:
    from pathlib import Path

Bytes = npt.NDArray[np.uint8]

DEFAULT_BOARD = CharucoBoard(squares_x=7, squares_y=5, square_m=0.030, marker_m=0.021, dictionary="DICT_4X4_50")
# White around the squares: the outermost markers need it.
MARGIN_M = 0.010
# Aluminium composite sheet, as sign makers use it: flat, and stiff enough at this size.
PLATE_M = 0.004
# The fingers hold a tab at the middle of the bottom edge, so long and so wide; their tips stay this far from the plate.
TAB_M = (0.020, 0.030)
_GAP_M = 0.005

# 762 dpi: a tenth of a millimetre is three pixels, so squares and markers of whole tenths have sharp edges.
_PX_PER_MM = 30
_DPI = 25.4 * _PX_PER_MM
_PAGES_MM = {"A4": (297, 210), "A3": (420, 297)}
_RULER_MM = 100
_EDGE_MM = 6.0
_FOOT_MM = 34.0
_TEXT_MM = 3.2


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


def bolted_to_flange(board: CharucoBoard) -> Array:
    """T_flange_board (4, 4) of a plate bolted flat to the flange in place of the gripper, its rows along flange x."""
    width, height = size_m(board)
    return make_transform(np.diag([1.0, -1.0, -1.0]), (-width / 2, height / 2, PLATE_M))


def draw_plate(board: CharucoBoard, px_per_mm: int) -> Bytes:
    """The plate with its white margin (h, w) uint8, at so many pixels per millimetre.

    Raises:
        ConfigError: as `opencv_board`.
    """
    width, height = (round(1000 * side * px_per_mm) for side in size_m(board))
    margin = round(1000 * MARGIN_M * px_per_mm)
    squares = opencv_board(board).generateImage((width, height))
    return np.pad(np.asarray(squares, np.uint8), margin, constant_values=255)


def save_page(board: CharucoBoard, path: Path) -> str:
    """Write a page to print, with a ruler and what to measure; A4, or A3 where the board needs it.

    Returns:
        The paper's name.

    Raises:
        ConfigError: the board fits on neither, or the file cannot be written.
    """
    plate = draw_plate(board, _PX_PER_MM)
    height, width = plate.shape
    fitting = [
        paper
        for paper, (w, h) in _PAGES_MM.items()
        if width <= _px(w - 2 * _EDGE_MM) and height <= _px(h - _EDGE_MM - _FOOT_MM)
    ]
    if not fitting:
        raise ConfigError(
            f"board: {width / _PX_PER_MM:.0f} x {height / _PX_PER_MM:.0f} mm with its margin does not fit on A3; use "
            "fewer or smaller squares"
        )
    page_w, page_h = _PAGES_MM[fitting[0]]
    page = Image.new("1", (_px(page_w), _px(page_h)), 1)
    left, top = (page.width - width) // 2, _px(_EDGE_MM)
    page.paste(Image.fromarray(plate).convert("1", dither=Image.Dither.NONE), (left, top))
    draw = ImageDraw.Draw(page)
    draw.rectangle((left, top, left + width - 1, top + height - 1), outline=0, width=_px(0.1))
    _draw_foot(draw, board, left, top + height)
    try:
        page.save(path, "PDF", resolution=_DPI, title="robotcell calibration board")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    return fitting[0]


def _px(mm: float) -> int:
    return round(mm * _PX_PER_MM)


def _draw_foot(draw: ImageDraw.ImageDraw, board: CharucoBoard, left: int, top: int) -> None:
    """Ruler and words below the plate."""
    font = ImageFont.load_default(_px(_TEXT_MM))
    y = top + _px(7)
    draw.line((left, y, left + _px(_RULER_MM), y), fill=0, width=_px(0.2))
    for mm in range(_RULER_MM + 1):
        length = 4.0 if mm % 10 == 0 else 2.5 if mm % 5 == 0 else 1.5
        x = left + _px(mm)
        draw.line((x, y - _px(length), x, y), fill=0, width=_px(0.1))
    for mm in range(0, _RULER_MM + 1, 50):
        draw.text((left + _px(mm), y + _px(0.8)), f"{mm} mm" if mm else "0", fill=0, font=font)
    along = board.squares_x
    lines = (
        f"ChArUco, {board.squares_x} x {board.squares_y} squares of {1000 * board.square_m:g} mm, markers of "
        f"{1000 * board.marker_m:g} mm, {board.dictionary}. Print at 100 %, not fitted to the page.",
        f"Measure with a steel rule: the ruler above is 100.0 mm, and the {along} squares of a row are "
        f"{1000 * along * board.square_m:.1f} mm, both within 0.2 mm.",
        f"If not, divide the measured row by {along} and give it as --square-mm. Glue the sheet flat on a stiff plate, "
        "cut along the line.",
        "The edge above the ruler, with a tab of 20 x 30 mm at its middle, goes to the gripper.",
    )
    x, y = left, y + _px(6)
    for line in lines:
        draw.text((x, y), line, fill=0, font=font)
        y += _px(_TEXT_MM + 1.2)
