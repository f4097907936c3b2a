"""`robotcell doctor` and `robotcell recover`: what is wrong with a cell, and leaving a stop."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import typer
from rich.table import Table
from rich.text import Text

from cli.console import progress, report_error, results
from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.drivers.doctor.examine import Finding, Grade, examine
from robotcell.errors import CellError

if TYPE_CHECKING:
    from pathlib import Path

_STYLES = {Grade.OK: "green", Grade.NOTE: "yellow", Grade.WRONG: "bold red"}
_SOMETHING_WRONG = 3


def run_doctor(cell_file: Path | None, seconds: float, *, as_json: bool) -> int:
    """Run the command; returns the exit code: 0 nothing is wrong, 2 configuration, 3 something is wrong."""
    try:
        config = load_config(cell_file)
        with progress().status(f"looking at the cell for {seconds:g} s"):
            findings = examine(config, seconds)
    except CellError as error:
        return report_error(error)
    wrong = any(finding.grade is Grade.WRONG for finding in findings)
    if as_json:
        rows = [{**vars(finding), "grade": finding.grade.value} for finding in findings]
        sys.stdout.write(json.dumps({"ok": not wrong, "findings": rows}) + "\n")
    else:
        _print(findings)
    return _SOMETHING_WRONG if wrong else 0


def run_recover(cell_file: Path | None, *, yes: bool) -> int:
    """Leave a stop after the operator has looked at the cell; returns the exit code."""
    try:
        config = load_config(cell_file)
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
