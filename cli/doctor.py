"""`robotcell doctor` and `robotcell recover`: what is wrong with a cell, and leaving a stop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer
from rich.text import Text

from cli.console import print_json, progress, report_error, results
from cli.findings import findings_as_json, print_findings
from robotcell.cell import open_cell
from robotcell.drivers.doctor.examine import examine
from robotcell.errors import CellError
from robotcell.findings import Grade

if TYPE_CHECKING:
    from cli.options import CellChoice

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
        print_json({"ok": not wrong, "findings": findings_as_json(findings)})
    else:
        print_findings(findings, results())
    return _SOMETHING_WRONG if wrong else 0


def run_recover(choice: CellChoice, *, yes: bool) -> int:
    """Leave a stop after the operator has looked at the cell; returns the exit code."""
    try:
        config = choice.load()
        cell = open_cell(config)
        question = (
            "Nothing touches the arm, nobody is within its reach, and what it holds may fall or stay: leave the stop?"
        )
        if not yes and not typer.confirm(question, err=True):
            progress().print("nothing was changed")
            return _SOMETHING_WRONG
        with progress().status("leaving the stop"), cell.arm as arm:
            cell.recover()
            mode = arm.state().mode.value
    except CellError as error:
        return report_error(error)
    results().print(Text(f"the arm is {mode}"))
    return 0
