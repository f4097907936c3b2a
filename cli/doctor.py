"""`robotcell doctor`: what is wrong with a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from cli.console import print_json, progress, report_error, results
from robotcell.drivers.doctor.examine import examine
from robotcell.drivers.doctor.findings import Finding, Grade
from robotcell.errors import CellError

if TYPE_CHECKING:
    from cli.options import CellChoice

_STYLES = {Grade.OK: "green", Grade.NOTE: "yellow", Grade.WRONG: "bold red"}
_SOMETHING_WRONG = 3


def run_doctor(choice: CellChoice, seconds: float, *, as_json: bool) -> int:
    """Run the command; returns the exit code: 0 nothing is wrong, 2 configuration, 3 something is wrong."""
    try:
        config = choice.load()
        with progress().status(f"looking at the cell for {seconds:g} s"):
            findings = examine(config, seconds)
    except CellError as error:
        return report_error(error, as_json=as_json)
    wrong = any(finding.grade is Grade.WRONG for finding in findings)
    if as_json:
        rows = [{**vars(finding), "grade": finding.grade.value} for finding in findings]
        print_json({"ok": not wrong, "findings": rows})
    else:
        _print(findings)
    return _SOMETHING_WRONG if wrong else 0


def _print(findings: list[Finding]) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("device", "what", "found", "", "what to do"):
        table.add_column(heading, overflow="fold")
    device = ""
    for finding in findings:
        table.add_row(
            Text(finding.device if finding.device != device else "", style="bold"),
            Text(finding.what),
            Text(finding.value),
            Text(finding.grade.value, style=_STYLES[finding.grade]),
            Text(finding.cure),
        )
        device = finding.device
    results().print(table)
