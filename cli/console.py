"""The two streams: results go to stdout, progress and errors to stderr."""

from __future__ import annotations

import json
import logging
import sys
from typing import Any

from rich.console import Console
from rich.text import Text

from robotcell.errors import CellError, ConfigError, NoTarget

_NOT_COMPLETE = 1
_WRONG_USAGE = 2
_STOPPED = 3

_WIDE = 200
_LOG = logging.getLogger("robotcell")


def results() -> Console:
    """A console for results. Not cut to 80 columns when they go to a file or another program."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE)


def progress() -> Console:
    """A console for progress and errors."""
    return Console(stderr=True, highlight=False)


def print_json(values: dict[str, Any]) -> None:
    """Print one JSON object on stdout."""
    sys.stdout.write(json.dumps(values) + "\n")


def show_log() -> None:
    """From now on what the program logs of itself goes to stderr."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.DEBUG)


def error_as_json(error: CellError | None) -> dict[str, Any]:
    """What programs need of an error: its kind and the device that it is about, both null where there is none."""
    return {"code": error.code if error else None, "device": error.device if error else None}


def exit_code(error: CellError) -> int:
    """The exit code that tells the operator what kind of thing to do next."""
    if isinstance(error, ConfigError):
        return _WRONG_USAGE
    return _NOT_COMPLETE if isinstance(error, NoTarget) else _STOPPED


def report_error(error: CellError, *, as_json: bool = False) -> int:
    """Print an error and return its exit code.

    Args:
        error: to be told.
        as_json: print it as a JSON object on stdout as well, for commands whose result it takes the place of.
    """
    if as_json:
        print_json({"error": str(error), **error_as_json(error)})
    progress().print(Text.assemble(("error: ", "bold red"), str(error)), soft_wrap=True)
    _LOG.debug("where it came from", exc_info=error)
    return exit_code(error)
