"""`robotcell calibrate solve`: reads views, solves them and prints the verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from calibration.collect.session import read_views
from calibration.solve.pipeline import solve, solve_series
from calibration.solve.readers.pose_csv import read_series
from calibration.solve.saving import save_if_better
from cli.console import print_json, progress, report_error, results
from robotcell.errors import CalibrationError, CellError, ConfigError
from robotcell.geometry.transforms import matrix_to_rotvec

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from calibration.solve.solution import Solution
    from robotcell.config.calibration_file import Mount

_REFUSED = 1


def run_solve(
    source: Path | None,
    mount: str | None,
    flange: Path | None,
    board: Path | None,
    *,
    refine_intrinsics: bool,
    out: Path | None,
    as_json: bool,
) -> int:
    """Run the command; returns the exit code. Progress and errors go to stderr, results to stdout."""
    try:
        with progress().status("solving"):
            solution = _solve(source, _mount(mount), flange, board, refine_intrinsics)
    except CellError as error:
        return report_error(error, as_json=as_json)
    if as_json:
        print_json(solution.as_json())
    else:
        print_solution(solution, results())
    if not solution.accepted:
        return _REFUSED
    if out is not None:
        try:
            save_if_better(solution, out)
        except CalibrationError as kept:
            report_error(kept)
            return _REFUSED
        except CellError as error:
            return report_error(error)
        progress().print(Text(f"written: {out}"), soft_wrap=True)
    return 0


def _mount(mount: str | None) -> Mount | None:
    if mount is None:
        return None
    if mount == "fixed":
        return "fixed"
    if mount == "flange":
        return "flange"
    raise ConfigError(f"--mount {mount}: it is fixed or flange")


def _solve(
    source: Path | None, mount: Mount | None, flange: Path | None, board: Path | None, refine_intrinsics: bool
) -> Solution:
    if (flange is None) != (board is None):
        raise ConfigError("--flange and --board belong together")
    if (source is None) == (flange is None):
        raise ConfigError("give either a file or folder of views, or --flange and --board")
    if flange is not None and board is not None:
        if refine_intrinsics:
            raise ConfigError("--refine-intrinsics needs corners; these are poses of the board")
        return solve_series(read_series(flange), read_series(board), mount or "fixed")
    assert source is not None
    views = read_views(source, mount)
    if refine_intrinsics and views.corners is None:
        raise ConfigError("--refine-intrinsics needs corners; these are poses of the board")
    return solve(views, refine_intrinsics=refine_intrinsics)


def print_solution(solution: Solution, out: Console) -> None:
    """Print verdict, errors and transform for people."""
    accepted = solution.accepted
    out.print(Text("accepted" if accepted else "refused", style="bold green" if accepted else "bold red"), end=": ")
    out.print(Text(solution.verdict.words), soft_wrap=True)
    if solution.verdict.cure:
        out.print(Text(solution.verdict.cure), soft_wrap=True)
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in _rows(solution):
        table.add_row(Text(key, style="bold"), Text(value, overflow="fold"))
    out.print(table)


def _rows(solution: Solution) -> list[tuple[str, str]]:
    views, estimate = solution.views, solution.estimate
    used = sum(view.used for view in solution.errors)
    rows = [("views", f"{used} used of {len(views)}")]
    if solution.rotation_spread_deg:
        turns = ", ".join(f"{angle:.0f}" for angle in solution.rotation_spread_deg)
        rows.append(("turns between views", f"{turns} degrees rms about three axes"))
    for unit, name in (("mm", "mm"), ("deg", "degrees"), ("px", "px")):
        spread = solution.spread(unit)
        if spread:
            rows.append(
                (f"held-out {name}", f"median {spread.median:.3f}, mean {spread.mean:.3f}, 95 % {spread.p95:.3f}")
            )
    if views.time_offset_s is not None:
        rows.append(("clock of the board", f"{1e3 * views.time_offset_s:+.1f} ms against that of the flange"))
    if estimate and solution.accepted:
        name = "T_base_camera" if views.mount == "fixed" else "T_flange_camera"
        sigma = np.sqrt(np.diag(estimate.covariance))
        rows += [
            (name, f"position {_numbers(estimate.X[:3, 3], 5)} m (+- {_numbers(1e3 * sigma[:3], 2)} mm)"),
            (
                "",
                f"rotation vector {_numbers(matrix_to_rotvec(estimate.X[:3, :3]), 5)} rad "
                f"(+- {_numbers(np.rad2deg(sigma[3:]), 3)} degrees)",
            ),
            ("scale", f"{estimate.scale:.4f} +- {estimate.scale_sigma:.4f} of the board's size, by the arm's motion"),
            ("noise", ", ".join(f"{key} {value:.2g}" for key, value in estimate.noise.items())),
            ("method", estimate.method),
        ]
    if estimate and estimate.camera and estimate.intrinsics_refined:
        camera = estimate.camera
        rows.append(
            ("intrinsics", f"fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f} px")
        )
    if estimate and estimate.depth:
        depth = estimate.depth
        rows.append(
            (
                "depth",
                f"true = {depth.scale:.4f} measured {1e3 * depth.offset_m:+.2f} mm; "
                f"{1e3 * depth.rms_before_m:.2f} mm rms before, {1e3 * depth.rms_after_m:.2f} after",
            )
        )
    rows += [(f"left out: {view.name}", view.why) for view in solution.errors if not view.used]
    return rows


def _numbers(values: np.typing.ArrayLike, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in np.asarray(values).tolist())
