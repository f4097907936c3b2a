"""How errors reach the operator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text

from robotcell.errors import CellError, ConfigError, NoTarget

if TYPE_CHECKING:
    from rich.console import Console

NOT_COMPLETE = 1
WRONG_USAGE = 2
STOPPED = 3


def exit_code(error: CellError) -> int:
    """The exit code that tells the operator what kind of thing to do next."""
    if isinstance(error, ConfigError):
        return WRONG_USAGE
    return NOT_COMPLETE if isinstance(error, NoTarget) else STOPPED


def report_error(error: CellError, console: Console) -> int:
    """Print an error and return its exit code."""
    console.print(Text.assemble(("error: ", "bold red"), str(error)), soft_wrap=True)
    return exit_code(error)
