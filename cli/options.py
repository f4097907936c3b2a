"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

CellFile = Annotated[
    Path | None, typer.Option("--cell", help="The cell's TOML file; without one, the twin with its defaults.")
]
Scene = Annotated[
    str | None, typer.Option(help="Twin: random, novel, challenging-01 to -10, or a scene file.", show_default=False)
]
Meshes = Annotated[
    Path | None, typer.Option(help="Twin: folder of the OBJ files that a scene file names.", show_default=False)
]
Objects = Annotated[int | None, typer.Option(help="Twin: how many objects a random scene has.", show_default=False)]
Seed = Annotated[int | None, typer.Option(help="Twin: the same seed gives the same scene.", show_default=False)]
