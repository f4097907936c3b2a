"""`robotcell calibrate`, `calibrate board` and `calibrate report`."""

from __future__ import annotations

import json
from datetime import datetime
from typing import TYPE_CHECKING, TypeAlias

import typer
from pydantic import ValidationError
from rich.text import Text

from calibration.collect.collection import RunningEstimate, collect, collect_by_hand, open_session
from calibration.collect.planning import HeldBoard
from calibration.collect.session import read_session
from calibration.report.page import write_report
from calibration.solve.readers.records import read_file
from calibration.solve.solution import save_if_better
from calibration.solve.solver import solve
from calibration.target.board import DEFAULT_BOARD, bolted_to_flange, held_by_gripper, save_page
from cli.calibrate_solve import print_solution
from cli.console import progress, report_error, results
from robotcell.cell import Cell, open_cell
from robotcell.config import CellConfig, load_config
from robotcell.config.calibration_file import CharucoBoard, FixedTag
from robotcell.errors import CalibrationError, CellError, ConfigError
from robotcell.geometry.rg2 import MIN_WIDTH_M
from robotcell.jobs.pictures import save_picture
from robotcell.motion.config_check import check_config
from robotcell.motion.executor import Executor
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, MotionPlan
from robotcell.perception.tags import check_tags, find_tags

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from calibration.collect.capture import Shot
    from calibration.solve.solution import Solution

# Squares along x and y, their side and that of the markers [mm], dictionary.
BoardOptions: TypeAlias = tuple[int, int, float, float | None, str]

_REFUSED = 1
_TWIN = "twin"
_HOLDS = {"gripper": held_by_gripper, "flange": bolted_to_flange}
_MARKER_SHARE = DEFAULT_BOARD.marker_m / DEFAULT_BOARD.square_m


def run_calibrate(
    cell_file: Path | None,
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
        if held_by not in _HOLDS:
            raise ConfigError(f"--held-by {held_by}: it is gripper or flange")
        config = _config(cell_file)
        if config.backend.name == _TWIN and (board != DEFAULT_BOARD or held_by != "gripper"):
            raise ConfigError("the twin holds the default board in its gripper: leave the board's options away")
        folder = resume or config.journal.runs / "calibration" / f"{datetime.now():%Y-%m-%d-%H%M%S}"
        with open_cell(config) as cell:
            frame = cell.camera.read()
            open_session(folder, board, frame, resume=resume is not None)
            tags = find_tags(frame.color)
            follower = _Progress(err, folder)
            err.print(Text(f"session {folder}"), soft_wrap=True)
            try:
                if freedrive:
                    collect_by_hand(cell, folder, board, views, follower.ask, follower)
                else:
                    _get_ready(cell, held_by, yes=yes)
                    collect(cell, folder, HeldBoard(board, _HOLDS[held_by](board)), views, seed, follower)
                    # The arm is back where it was, so it hides what it hid then.
                    check_tags(cell.camera.read().color, tags)
            finally:
                follower.end(len(read_session(folder)), views)
        return _conclude(folder, out, tags, cell_file, err)
    except CalibrationError as refusal:
        report_error(refusal)
        return _REFUSED
    except CellError as error:
        return report_error(error)


def run_board(board_options: BoardOptions, pdf: Path) -> int:
    """Write the page; returns the exit code."""
    try:
        board = make_board(board_options)
        paper = save_page(board, pdf)
    except CellError as error:
        return report_error(error)
    results().print(
        Text(f"{pdf}: print on {paper} at 100 %, then measure the ruler and the squares as the page says"),
        soft_wrap=True,
    )
    return 0


def run_report(source: Path, out: Path) -> int:
    """Solve and write the report; returns the exit code."""
    try:
        with progress().status("solving"):
            folder = source if source.is_dir() else None
            solution = solve(read_session(source) if folder else read_file(source))
            write_report(solution, out, folder)
    except CellError as error:
        return report_error(error)
    results().print(Text(f"{'accepted' if solution.accepted else 'refused'}: {solution.verdict.words}"), soft_wrap=True)
    results().print(Text(f"report: {out}"), soft_wrap=True)
    return 0 if solution.accepted else _REFUSED


def make_board(options: BoardOptions) -> CharucoBoard:
    """The board of the options.

    Raises:
        ConfigError: there can be no such board.
    """
    squares_x, squares_y, square_mm, marker_mm, dictionary = options
    marker_m = square_mm * _MARKER_SHARE if marker_mm is None else marker_mm
    try:
        return CharucoBoard(
            squares_x=squares_x,
            squares_y=squares_y,
            square_m=round(square_mm / 1000, 7),
            marker_m=round(marker_m / 1000, 7),
            dictionary=dictionary,
        )
    except ValidationError as error:
        problems = "; ".join(detail["msg"].removeprefix("Value error, ") for detail in error.errors())
        raise ConfigError(f"board: {problems}") from error


def _config(cell_file: Path | None) -> CellConfig:
    """The cell as it is while it is calibrated: without the calibration that may be stale, in a twin with the board."""
    config = load_config(cell_file)
    camera = config.camera
    if config.backend.name == _TWIN:
        # The points say where the twin's camera stands, so they must stay.
        camera = camera.model_copy(update={"calibration": None})
        options = {**config.backend.options, "board": True}
        config = config.model_copy(update={"backend": config.backend.model_copy(update={"options": options})})
    elif camera.measured is not None:
        T = tuple(tuple(row) for row in camera.pose().tolist())
        camera = camera.model_copy(update={"calibration": None, "T_base_camera": T})
    camera = type(camera).model_validate(camera.model_dump())
    config = config.model_copy(update={"camera": camera})
    check_config(config)
    return config


def _get_ready(cell: Cell, held_by: str, *, yes: bool) -> None:
    """Ask the operator, and close the fingers on the tab."""
    if cell.config.backend.name != _TWIN and not yes:
        question = "The arm will move by itself, with the board. Is the cell clear"
        if held_by == "gripper":
            question += ", and the tab of the board between the fingers, printed side up? They close now"
        if not typer.confirm(f"{question}?".replace("??", "?"), err=True):
            raise ConfigError("nothing was moved")
    if held_by == "gripper":
        grip = Grip("hold the board", MIN_WIDTH_M, cell.config.gripper.force_n)
        Executor(cell).run(check_path(MotionPlan("hold the board", cell.arm.state().q, (grip,)), cell.config))


def _conclude(folder: Path, out: Path, tags: tuple[FixedTag, ...], cell_file: Path | None, err: Console) -> int:
    """Solve, report, and write the calibration where it is accepted; returns the exit code."""
    with err.status("solving"):
        solution = solve(read_session(folder))
        _write_result(solution, folder)
        write_report(solution, folder / "report.html", folder)
    print_solution(solution, results())
    results().print(Text(f"report: {folder / 'report.html'}"), soft_wrap=True)
    if not solution.accepted:
        return _REFUSED
    for path in (folder / "calibration.json", out):
        save_if_better(solution, path, tags)
    if tags:
        err.print(Text(f"fixed tags in view: {', '.join(str(tag.id) for tag in tags)}"))
    beside = cell_file is not None and out.resolve().parent == cell_file.resolve().parent
    line = f'calibration = "{out.name if beside else out.resolve().as_posix()}"'
    err.print(Text(f"written: {out}. In {cell_file or 'cell.toml'}:\n\n[camera]\n{line}"), soft_wrap=True)
    return 0


def _write_result(solution: Solution, folder: Path) -> None:
    path = folder / "result.json"
    try:
        path.write_text(json.dumps(solution.as_json(), indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


class _Progress:
    """Prints a line per view, and keeps a picture of the newest one."""

    def __init__(self, console: Console, folder: Path) -> None:
        self._console = console
        self._folder = folder
        self._status = console.status("planning the poses")
        self._status.start()

    def going(self, taken: int, count: int) -> None:
        """Show how far it is."""
        self._status.update(f"view {taken + 1} of {count}")

    def took(self, shot: Shot, taken: int, count: int, estimate: RunningEstimate | None) -> None:
        """Print what a view came to."""
        save_picture(shot.picture(), self._folder / "latest.png")
        if shot.detection.refused:
            self._console.print(Text(f"not used: {shot.detection.refused}", style="yellow"), soft_wrap=True)
            return
        line = f"view {taken} of {count}: {len(shot.detection.corners.ids)} corners"
        if estimate is not None:
            place = ", ".join(f"{value:.4f}" for value in estimate.T_base_camera[:3, 3])
            line += f"; camera at {place} m, views agree within {1000 * estimate.disagreement_m:.2f} mm"
        self._console.print(Text(line), soft_wrap=True)

    def skipped(self, why: str) -> None:
        """Print why a pose was left out."""
        self._console.print(Text(f"left out: {why}", style="yellow"), soft_wrap=True)

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
