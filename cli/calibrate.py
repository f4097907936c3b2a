"""`robotcell calibrate`: where the camera stands, from views to a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.calibrate_cell import register

# Everything heavy is imported inside the commands, so that --help answers at once.

app = typer.Typer(help="Find where the camera stands.", pretty_exceptions_enable=False)
register(app)

Source = Annotated[
    Path | None, typer.Argument(help="pairs.json, corners.json, or the folder of a session.", show_default=False)
]


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
) -> None:
    """Solve recorded views, of this program or of others: poses, corners, a session, or two time series.

    Exit codes: 0 accepted, 1 refused, or the file that stands there is better, 2 usage or files.
    """
    from cli.calibrate_solve import run_solve

    raise typer.Exit(
        run_solve(source, mount, flange, board, refine_intrinsics=refine_intrinsics, out=out, as_json=json_)
    )
