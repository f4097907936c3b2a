"""The two streams: results go to stdout, progress and errors to stderr."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.text import Text

from robotcell.errors import CellError, ConfigError, NoTarget

_NOT_COMPLETE = 1
_WRONG_USAGE = 2
_STOPPED = 3

_WIDE = 200


def results() -> Console:
    """A console for results. Not cut to 80 columns when they go to a file or another program."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE)


def progress() -> Console:
    """A console for progress and errors."""
    return Console(stderr=True, highlight=False)


def exit_code(error: CellError) -> int:
    """The exit code that tells the operator what kind of thing to do next."""
    if isinstance(error, ConfigError):
        return _WRONG_USAGE
    return _NOT_COMPLETE if isinstance(error, NoTarget) else _STOPPED


def report_error(error: CellError) -> int:
    """Print an error and return its exit code."""
    progress().print(Text.assemble(("error: ", "bold red"), str(error)), soft_wrap=True)
    return exit_code(error)
