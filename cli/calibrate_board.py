"""`robotcell calibrate board`: the board as a page to print."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from pydantic import ValidationError
from rich.text import Text

from calibration.target.board_page import save_page
from cli.console import report_error, results
from robotcell.config.calibration_file import CharucoBoard
from robotcell.errors import CellError, ConfigError
from robotcell.perception.board_plate import DEFAULT_BOARD

if TYPE_CHECKING:
    from pathlib import Path

# Squares along x and y, their side and that of the markers [mm], dictionary.
BoardOptions: TypeAlias = tuple[int, int, float, float | None, str]

_MARKER_SHARE = DEFAULT_BOARD.marker_m / DEFAULT_BOARD.square_m


def run_board(board_options: BoardOptions, pdf: Path) -> int:
    """Write the page; returns the exit code."""
    try:
        board = make_board(board_options)
        paper = save_page(board, pdf)
    except CellError as error:
        return report_error(error)
    results().print(
        Text(f"{pdf}: print on {paper} at 100 %, then measure the ruler and the squares as the page says"),
        soft_wrap=True,
    )
    return 0


def make_board(options: BoardOptions) -> CharucoBoard:
    """The board of the options.

    Raises:
        ConfigError: there can be no such board.
    """
    squares_x, squares_y, square_mm, marker_mm, dictionary = options
    marker_m = square_mm * _MARKER_SHARE if marker_mm is None else marker_mm
    try:
        return CharucoBoard(
            squares_x=squares_x,
            squares_y=squares_y,
            square_m=round(square_mm / 1000, 7),
            marker_m=round(marker_m / 1000, 7),
            dictionary=dictionary,
        )
    except ValidationError as error:
        problems = "; ".join(detail["msg"].removeprefix("Value error, ") for detail in error.errors())
        raise ConfigError(f"board: {problems}") from error
