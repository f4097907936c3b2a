"""The calibration board as a page to print, with a ruler and what to measure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PIL import Image, ImageDraw, ImageFont

from robotcell.errors import ConfigError
from robotcell.io.atomic_file import replaced
from robotcell.perception.board_plate import draw_plate

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.config.calibration_file import CharucoBoard

# 762 dpi: a tenth of a millimetre is three pixels, so squares and markers of whole tenths have sharp edges.
_PX_PER_MM = 30
_DPI = 25.4 * _PX_PER_MM
_PAGES_MM = {"A4": (297, 210), "A3": (420, 297)}
_RULER_MM = 100
_EDGE_MM = 6.0
_FOOT_MM = 34.0
_TEXT_MM = 3.2


def save_page(board: CharucoBoard, path: Path) -> str:
    """Write a page to print, with a ruler and what to measure; A4, or A3 where the board needs it.

    Returns:
        The paper's name.

    Raises:
        ConfigError: the board fits on neither.
        StorageError: the file cannot be written.
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
    with replaced(path) as part:
        page.save(part, "PDF", resolution=_DPI, title="robotcell calibration board")
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
