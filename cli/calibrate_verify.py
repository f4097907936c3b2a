"""`robotcell calibrate verify`: whether the calibration is good enough to pick with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from calibration.verify import HOVER_M, Verification, verify
from cli.console import print_json, progress, report_error, results
from robotcell.errors import CalibrationError, CellError
from robotcell.jobs.opening import open_cell
from robotcell.motion.config_check import check_config

if TYPE_CHECKING:
    from cli.options import CellChoice
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array

_NOT_GOOD = 1
_TWIN = "twin"


def run_verify(cell_choice: CellChoice, points: int, *, touch: bool, yes: bool, as_json: bool) -> int:
    """Run the command; returns the exit code."""
    try:
        config = cell_choice.load()
        check_config(config)
        alone = yes or config.backend.name == _TWIN
        with open_cell(config) as cell:
            verification = verify(
                cell,
                points,
                touch=touch,
                consent=lambda: alone or _ask(points, touch=touch),
                hovering=lambda number, count, spot: _stand_over(number, count, spot, wait=not alone),
            )
    except CalibrationError as error:
        report_error(error, as_json=as_json)
        return _NOT_GOOD
    except CellError as error:
        return report_error(error, as_json=as_json)
    problems = verification.problems(config)
    if as_json:
        print_json(_plain(verification, problems))
    else:
        _print(verification, problems, config)
    return _NOT_GOOD if problems else 0


def _ask(points: int, *, touch: bool) -> bool:
    deed = "feel for the table" if touch else "hover over the table"
    return typer.confirm(f"The arm will {deed} at {points} bare spots. Is the cell clear, the gripper empty?", err=True)


def _stand_over(number: int, count: int, spot: Array, *, wait: bool) -> None:
    """Say where the tips stand, and give the operator the time to measure the gap."""
    where = f"spot {number} of {count}, x {spot[0]:.3f}, y {spot[1]:.3f} m"
    progress().print(Text(f"{where}: the tips stand {1000 * HOVER_M:.0f} mm over the table"), soft_wrap=True)
    if wait:
        typer.prompt("Measure the gap, then press Enter", default="", show_default=False, err=True)


def _plain(verification: Verification, problems: list[str]) -> dict[str, Any]:
    table = verification.table
    return {
        "ok": not problems,
        "problems": problems,
        "table": {
            "tilt_deg": float(np.degrees(table.tilt_rad)),
            "offset_mm": 1000 * table.offset_m,
            "rms_mm": 1000 * table.rms_m,
        },
        "spots": [
            {
                "place_m": touch.place.tolist(),
                "touched_m": touch.touched_m,
                "difference_mm": None if touch.difference_m is None else 1000 * touch.difference_m,
            }
            for touch in verification.touches
        ],
    }


def _print(verification: Verification, problems: list[str], config: CellConfig) -> None:
    out, plane = results(), verification.table
    out.print(
        Text(
            f"table: tilted by {np.degrees(plane.tilt_rad):.2f} degrees "
            f"(limit {np.degrees(config.limits.max_tilt_rad):.2f}), {1000 * plane.offset_m:+.1f} mm off "
            f"(limit {1000 * config.limits.max_table_offset_m:.1f}), noise {1000 * plane.rms_m:.1f} mm"
        ),
        soft_wrap=True,
    )
    table = Table(box=None, pad_edge=False)
    for heading in ("x m", "y m", "camera mm", "arm mm", "camera - arm mm"):
        table.add_column(heading, justify="right")
    for touch in verification.touches:
        arm = "hovered" if touch.touched_m is None else f"{1000 * touch.touched_m:.2f}"
        off = "" if touch.difference_m is None else f"{1000 * touch.difference_m:+.2f}"
        table.add_row(f"{touch.place[0]:.3f}", f"{touch.place[1]:.3f}", f"{1000 * touch.place[2]:.2f}", arm, off)
    out.print(table)
    for problem in problems:
        out.print(Text(problem, style="bold red"), soft_wrap=True)
    if not problems:
        out.print(Text("good enough to pick with", style="bold green"))
