"""How findings are shown: the doctor's and those of a job's preflight."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from robotcell.findings import Finding, Grade

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

_STYLES = {Grade.OK: "green", Grade.NOTE: "yellow", Grade.WRONG: "bold red"}


def print_findings(findings: Sequence[Finding], console: Console) -> None:
    """Print them as a table."""
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
    console.print(table)


def findings_as_json(findings: Sequence[Finding]) -> list[dict[str, str]]:
    """What programs need of them."""
    keys = ("device", "what", "value", "cure")
    return [{**{key: getattr(finding, key) for key in keys}, "grade": finding.grade.value} for finding in findings]
