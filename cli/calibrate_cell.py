"""The commands of `robotcell calibrate` that need a cell, and those for the board and the report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import CellFile  # noqa: TC001 - typer reads it

# Everything heavy is imported inside the commands, so that --help answers at once.

SquaresX = Annotated[int, typer.Option(min=3, help="Squares of the board along its rows.")]
SquaresY = Annotated[int, typer.Option(min=3, help="Squares along its columns.")]
SquareMm = Annotated[float, typer.Option(min=5, max=200, help="Side of a square, as measured on the print.")]
MarkerMm = Annotated[
    float | None, typer.Option(min=3, max=200, help="Side of a marker; 0.7 squares unless given.", show_default=False)
]
Dictionary = Annotated[str, typer.Option(help="OpenCV's name of the markers' dictionary.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves: the cell was looked at.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the sub-app; the first is what it does without a command."""
    app.callback(invoke_without_command=True)(calibrate)
    for command in (board, verify, report):
        app.command()(command)


def calibrate(
    context: typer.Context,
    cell: CellFile = None,
    views: Annotated[int, typer.Option(min=3, max=500, help="How many views; 12 are needed, 20 recommended.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of the poses: the same seed plans the same ones.")] = 0,
    out: Annotated[Path, typer.Option(help="The calibration file; one that is better is kept.")] = Path(
        "calibration.json"
    ),
    freedrive: Annotated[
        bool,
        typer.Option("--freedrive", help="You move the arm by its freedrive button, and press Enter at each view."),
    ] = False,
    resume: Annotated[
        Path | None, typer.Option(help="Go on with the session in this folder.", show_default=False)
    ] = None,
    held_by: Annotated[str, typer.Option(help="What holds the board: gripper or flange.")] = "gripper",
    squares_x: SquaresX = 7,
    squares_y: SquaresY = 5,
    square_mm: SquareMm = 30.0,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "DICT_4X4_50",
    yes: Yes = False,
) -> None:
    """Find where the fixed camera stands: look at the board in many poses of the arm, solve, judge, report.

    Exit codes: 0 accepted and written, 1 refused or a better one was kept, 2 usage or configuration, 3 a device or the
    safety layer stopped the cell, 130 interrupted (go on with --resume).
    """
    if context.invoked_subcommand is not None:
        return
    from cli.calibrate_run import run_calibrate

    raise typer.Exit(
        run_calibrate(
            cell,
            (squares_x, squares_y, square_mm, marker_mm, dictionary),
            views=views,
            seed=seed,
            out=out,
            freedrive=freedrive,
            resume=resume,
            held_by=held_by,
            yes=yes,
        )
    )


def board(
    pdf: Annotated[Path, typer.Option(help="Where to write the page.")] = Path("board.pdf"),
    squares_x: SquaresX = 7,
    squares_y: SquaresY = 5,
    square_mm: SquareMm = 30.0,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "DICT_4X4_50",
) -> None:
    """Write the board as a page to print, with a ruler to check the print by.

    Exit codes: 0 written, 2 usage.
    """
    from cli.calibrate_run import run_board

    raise typer.Exit(run_board((squares_x, squares_y, square_mm, marker_mm, dictionary), pdf))


def verify(
    cell: CellFile = None,
    points: Annotated[int, typer.Option(min=1, max=20, help="How many spots of the table.")] = 4,
    touch: Annotated[
        bool, typer.Option("--touch", help="Feel for the table at each spot instead of hovering over it.")
    ] = False,
    yes: Yes = False,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON result and nothing else.")] = False,
) -> None:
    """Check the cell's calibration: the table in the heightmap, and spots of it that the arm goes to.

    Exit codes: 0 good enough to pick with, 1 not, 2 usage or configuration, 3 a device or the safety layer stopped.
    """
    from cli.calibrate_verify import run_verify

    raise typer.Exit(run_verify(cell, points, touch=touch, yes=yes, as_json=json_))


def report(
    source: Annotated[Path, typer.Argument(help="pairs.json, corners.json, or the folder of a session.")],
    out: Annotated[Path, typer.Option(help="Where to write the page.")] = Path("report.html"),
) -> None:
    """Solve recorded views and write the report of it as one HTML file.

    Exit codes: 0 accepted, 1 refused (the report says why), 2 usage or files.
    """
    from cli.calibrate_run import run_report

    raise typer.Exit(run_report(source, out))
