"""Options that several commands share, and the cell that they describe."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from robotcell.config import CellConfig


def _verbose(value: bool) -> None:
    if value:
        from cli.console import show_log

        show_log()


CellFile = Annotated[
    Path | None, typer.Option("--cell", help="The cell's TOML file; without one, the twin with its defaults.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A setting above that of the cell's file, any number of times.",
        show_default=False,
    ),
]
Scene = Annotated[
    str | None,
    typer.Option(help="Twin: random, random-goal, novel, challenging-01 to -10, or a scene file.", show_default=False),
]
Meshes = Annotated[
    Path | None, typer.Option(help="Twin: folder of the meshes that a scene file names.", show_default=False)
]
Objects = Annotated[int | None, typer.Option(help="Twin: how many objects a random scene has.", show_default=False)]
Seed = Annotated[int | None, typer.Option(help="Twin: the same seed gives the same scene.", show_default=False)]
Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", callback=_verbose, is_eager=True, help="Say what happens inside, and where errors come from."
    ),
]

# What each option sets in the cell's file.
_KEYS = {
    "--scene": "backend.options.scene",
    "--meshes": "backend.options.meshes",
    "--objects": "backend.options.objects",
    "--seed": "backend.options.seed",
    "--policy": "policy.name",
    "--speed": "motion.speed_fraction",
}


@dataclass(frozen=True)
class CellChoice:
    """The cell that a command's options describe.

    Attributes:
        file: value of --cell.
        settings: values of --set, above the file.
        options: values of options of their own, such as `--seed`, above both; None where one was not given.
    """

    file: Path | None
    settings: list[str] | None = None
    options: Mapping[str, object] = field(default_factory=dict)

    def load(self) -> CellConfig:
        """The cell's configuration.

        Raises:
            ConfigError: something is wrong in one of them, named as the user gave it.
        """
        from robotcell.config import load_config

        return load_config(self.file, *self.overrides())

    def overrides(self) -> tuple[dict[str, object], dict[str, str]]:
        """The values above the file, and how the user gave each, by dotted key.

        Raises:
            ConfigError: a value of --set is no KEY=VALUE.
        """
        from robotcell.config import parse_setting

        overrides: dict[str, object] = {}
        said_as: dict[str, str] = {}
        for text in self.settings or []:
            key, value = parse_setting(text)
            overrides[key], said_as[key] = value, f"--set {key}="
        for option, value in self.options.items():
            if value is not None:
                key = _KEYS[option]
                overrides[key], said_as[key] = value, f"{option} "
        return overrides, said_as
