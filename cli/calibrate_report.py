"""`robotcell calibrate report`: the report of recorded views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text

from calibration.report.page import rebuild_report
from cli.console import progress, report_error, results
from robotcell.errors import CellError

if TYPE_CHECKING:
    from pathlib import Path

_REFUSED = 1


def run_report(source: Path, out: Path) -> int:
    """Solve and write the report; returns the exit code."""
    try:
        with progress().status("solving"):
            solution = rebuild_report(source, out)
    except CellError as error:
        return report_error(error)
    results().print(Text(f"{'accepted' if solution.accepted else 'refused'}: {solution.verdict.words}"), soft_wrap=True)
    results().print(Text(f"report: {out}"), soft_wrap=True)
    return 0 if solution.accepted else _REFUSED
