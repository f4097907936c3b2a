"""`robotcell calibrate`: where the fixed camera of a cell stands."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

import typer
from rich.text import Text

from calibration.collect.acquisition import collect_by_hand
from calibration.collect.session import read_session
from calibration.procedure import REPORT, cell_to_calibrate, save_solution, solve_session, start_session, take_views
from calibration.target.held_board import HOLDERS, HeldBoard
from cli.calibrate_board import BoardOptions, make_board
from cli.calibrate_solve import print_solution
from cli.console import progress, report_error, results
from robotcell.errors import CalibrationError, CellError, ConfigError
from robotcell.jobs.opening import open_cell

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from calibration.collect.capture import Capture
    from calibration.collect.running_estimate import RunningEstimate
    from cli.options import CellChoice
    from robotcell.config.calibration_file import FixedTag

_REFUSED = 1
_TWIN = "twin"
_GRIPPER = "gripper"
_MOVE_QUESTION = "The arm will move by itself, with the board. Is the cell clear?"
_CLOSE_QUESTION = (
    "The fingers close now, and the arm will move by itself. Is the cell clear, and the tab of the board between the "
    "fingers, printed side up?"
)


def run_calibrate(
    cell_choice: CellChoice,
    board_options: BoardOptions,
    *,
    views: int,
    seed: int,
    out: Path,
    freedrive: bool,
    resume: Path | None,
    held_by: str,
    yes: bool,
) -> int:
    """Collect, solve, judge and report; returns the exit code."""
    err = progress()
    try:
        board = make_board(board_options)
        if held_by not in HOLDERS:
            raise ConfigError(f"--held-by {held_by}: it is gripper or flange")
        in_gripper = held_by == _GRIPPER
        config = cell_to_calibrate(cell_choice.load(), board, in_gripper=in_gripper)
        folder = resume or config.journal.runs / "calibration" / f"{datetime.now():%Y-%m-%d-%H%M%S}"
        alone = yes or config.backend.name == _TWIN
        with open_cell(config) as cell:
            tags = start_session(cell, folder, board, resume=resume is not None)
            err.print(Text(f"session {folder}"), soft_wrap=True)
            shown = _Progress(err, folder)
            try:
                if freedrive:
                    collect_by_hand(cell, folder, board, views, shown.ask, shown)
                else:
                    take_views(
                        cell,
                        folder,
                        HeldBoard(board, HOLDERS[held_by](board)),
                        views,
                        seed,
                        shown,
                        tags=tags,
                        in_gripper=in_gripper,
                        consent=lambda: alone or shown.consent(in_gripper=in_gripper),
                    )
            finally:
                shown.end(len(read_session(folder)), views)
        return _conclude(folder, out, tags, cell_choice.file, err)
    except CalibrationError as refusal:
        report_error(refusal)
        return _REFUSED
    except CellError as error:
        return report_error(error)


def _conclude(folder: Path, out: Path, tags: tuple[FixedTag, ...], cell_file: Path | None, err: Console) -> int:
    """Solve, report, and write the calibration where it is accepted; returns the exit code."""
    with err.status("solving"):
        solution = solve_session(folder)
    print_solution(solution, results())
    results().print(Text(f"report: {folder / REPORT}"), soft_wrap=True)
    if not solution.accepted:
        return _REFUSED
    save_solution(solution, folder, out, tags)
    if tags:
        err.print(Text(f"fixed tags in view: {', '.join(str(tag.id) for tag in tags)}"))
    beside = cell_file is not None and out.resolve().parent == cell_file.resolve().parent
    line = f'calibration = "{out.name if beside else out.resolve().as_posix()}"'
    err.print(Text(f"written: {out}. In {cell_file or 'cell.toml'}:\n\n[camera]\n{line}"), soft_wrap=True)
    return 0


class _Progress:
    """Prints a line per view."""

    def __init__(self, console: Console, folder: Path) -> None:
        self._console = console
        self._folder = folder
        self._status = console.status("planning the poses")
        self._status.start()

    def moving(self, taken: int, count: int) -> None:
        """Show how far it is."""
        self._status.update(f"view {taken + 1} of {count}")

    def captured(self, capture: Capture, taken: int, count: int, estimate: RunningEstimate | None) -> None:
        """Print what a view came to."""
        if capture.detection.refused:
            self._console.print(Text(f"not used: {capture.detection.refused}", style="yellow"), soft_wrap=True)
            return
        line = f"view {taken} of {count}: {len(capture.detection.corners.ids)} corners"
        if estimate is not None:
            place = ", ".join(f"{value:.4f}" for value in estimate.T_base_camera[:3, 3])
            line += f"; camera at {place} m, views agree within {1000 * estimate.disagreement_m:.2f} mm"
        self._console.print(Text(line), soft_wrap=True)

    def skipped(self, why: str) -> None:
        """Print why a pose was left out."""
        self._console.print(Text(f"left out: {why}", style="yellow"), soft_wrap=True)

    def consent(self, *, in_gripper: bool) -> bool:
        """Ask whether the arm may move."""
        self._status.stop()
        given = typer.confirm(_CLOSE_QUESTION if in_gripper else _MOVE_QUESTION, err=True)
        self._status.start()
        return given

    def ask(self) -> bool:
        """Wait until the operator has put the arm somewhere."""
        self._status.stop()
        words = "Move the arm with the pendant's freedrive button, let go, then press Enter; q and Enter to end"
        return not typer.prompt(words, default="", show_default=False, err=True).strip().lower().startswith("q")

    def end(self, taken: int, count: int) -> None:
        """Say what is kept of a collection that was cut short."""
        self._status.stop()
        if taken >= count:
            return
        self._console.print(
            Text(f"{taken} views in {self._folder}; go on there with --resume {self._folder}"), soft_wrap=True
        )
