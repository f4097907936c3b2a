"""`robotcell calibrate`: the options of its commands. What they do is in `cli.calibrate_*`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import CellChoice, CellFile, Settings, Verbose

# Everything heavy is imported inside the commands, so that --help answers at once.

app = typer.Typer(help="Find where the camera stands.", pretty_exceptions_enable=False)

Source = Annotated[
    Path | None, typer.Argument(help="pairs.json, corners.json, or the folder of a session.", show_default=False)
]
SquaresX = Annotated[int, typer.Option(min=3, help="Squares of the board along its rows.")]
SquaresY = Annotated[int, typer.Option(min=3, help="Squares along its columns.")]
SquareMm = Annotated[float, typer.Option(min=5, max=200, help="Side of a square, as measured on the print.")]
MarkerMm = Annotated[
    float | None, typer.Option(min=3, max=200, help="Side of a marker; 0.7 squares unless given.", show_default=False)
]
Dictionary = Annotated[str, typer.Option(help="OpenCV's name of the markers' dictionary.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves: the cell was looked at.")]


@app.callback(invoke_without_command=True)
def calibrate(
    context: typer.Context,
    cell: CellFile = None,
    settings: Settings = None,
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
    verbose: Verbose = False,
) -> None:
    """Find where the fixed camera stands: look at the board in many poses of the arm, solve, judge, report.

    Exit codes: 0 accepted and written, 1 refused or a better one was kept, 2 usage or configuration, 3 a device or the
    safety layer stopped the cell, 130 interrupted (go on with --resume).
    """
    if context.invoked_subcommand is not None:
        return
    from cli.calibrate_camera import run_calibrate

    raise typer.Exit(
        run_calibrate(
            CellChoice(cell, settings),
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


@app.command()
def board(
    pdf: Annotated[Path, typer.Option(help="Where to write the page.")] = Path("board.pdf"),
    squares_x: SquaresX = 7,
    squares_y: SquaresY = 5,
    square_mm: SquareMm = 30.0,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "DICT_4X4_50",
    verbose: Verbose = False,
) -> None:
    """Write the board as a page to print, with a ruler to check the print by.

    Exit codes: 0 written, 2 usage.
    """
    from cli.calibrate_board import run_board

    raise typer.Exit(run_board((squares_x, squares_y, square_mm, marker_mm, dictionary), pdf))


@app.command()
def verify(
    cell: CellFile = None,
    settings: Settings = None,
    points: Annotated[int, typer.Option(min=1, max=20, help="How many spots of the table.")] = 4,
    touch: Annotated[
        bool, typer.Option("--touch", help="Feel for the table at each spot instead of hovering over it.")
    ] = False,
    yes: Yes = False,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON result and nothing else.")] = False,
    verbose: Verbose = False,
) -> None:
    """Check the cell's calibration: the table in the heightmap, and spots of it that the arm goes to.

    Exit codes: 0 good enough to pick with, 1 not, 2 usage or configuration, 3 a device or the safety layer stopped.
    """
    from cli.calibrate_verify import run_verify

    raise typer.Exit(run_verify(CellChoice(cell, settings), points, touch=touch, yes=yes, as_json=json_))


@app.command()
def report(
    source: Annotated[Path, typer.Argument(help="pairs.json, corners.json, or the folder of a session.")],
    out: Annotated[Path, typer.Option(help="Where to write the page.")] = Path("report.html"),
    verbose: Verbose = False,
) -> None:
    """Solve recorded views and write the report of it as one HTML file.

    Exit codes: 0 accepted, 1 refused (the report says why), 2 usage or files.
    """
    from cli.calibrate_report import run_report

    raise typer.Exit(run_report(source, out))


@app.command()
def solve(
    source: Source = None,
    mount: Annotated[
        str | None,
        typer.Option(help="Where the camera is: fixed or flange; fixed unless the file says it.", show_default=False),
    ] = None,
    flange: Annotated[
        Path | None, typer.Option(help="CSV of T_base_flange over time: t,x,y,z,qx,qy,qz,qw.", show_default=False)
    ] = None,
    board: Annotated[
        Path | None, typer.Option(help="CSV of T_camera_board over time, by its own clock.", show_default=False)
    ] = None,
    refine_intrinsics: Annotated[
        bool, typer.Option("--refine-intrinsics", help="Estimate focal lengths, principal point and distortion too.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Write the calibration file here, unless a better one stands there.", show_default=False),
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON result and nothing else.")] = False,
    verbose: Verbose = False,
) -> None:
    """Solve recorded views, of this program or of others: poses, corners, a session, or two time series.

    Exit codes: 0 accepted, 1 refused, or the file that stands there is better, 2 usage or files.
    """
    from cli.calibrate_solve import run_solve

    raise typer.Exit(
        run_solve(source, mount, flange, board, refine_intrinsics=refine_intrinsics, out=out, as_json=json_)
    )
