"""`robotcell doctor`: what is wrong with a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cli.console import print_json, progress, report_error, results
from cli.findings import findings_as_json, print_findings
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
