"""The whole calibration of a cell's fixed camera: hold the board, take views, solve, judge, report, save."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from calibration.collect.acquisition import collect
from calibration.collect.session import open_session, read_session
from calibration.report.page import write_report
from calibration.solve.pipeline import solve
from calibration.solve.saving import save_if_better
from robotcell.config.fingers import closed_width
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import write_whole
from robotcell.motion.config_check import check_config
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, MotionPlan
from robotcell.perception.board_plate import DEFAULT_BOARD
from robotcell.perception.tags import check_tags, find_tags

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from calibration.collect.acquisition import CollectionProgress
    from calibration.solve.solution import Solution
    from calibration.target.held_board import HeldBoard
    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from robotcell.config.calibration_file import CharucoBoard, FixedTag

REPORT = "report.html"
_TWIN = "twin"


def cell_to_calibrate(config: CellConfig, board: CharucoBoard, *, in_gripper: bool) -> CellConfig:
    """The cell as it is while it is calibrated: without a calibration that may be stale, in a twin with the board.

    Args:
        config: of the cell.
        board: that the arm carries.
        in_gripper: the gripper holds it, rather than the flange.

    Raises:
        ConfigError: the twin has no such board, or the parts of the configuration do not fit each other.
    """
    camera = config.camera
    if config.backend.name == _TWIN:
        if board != DEFAULT_BOARD or not in_gripper:
            raise ConfigError("the twin holds the default board in its gripper: leave the board's options away")
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


def start_session(cell: Cell, folder: Path, board: CharucoBoard, *, resume: bool) -> tuple[FixedTag, ...]:
    """Start a session, or go on with one.

    Args:
        cell: open, configured by `cell_to_calibrate`.
        folder: of the session.
        board: that the arm carries.
        resume: there is a session already.

    Returns:
        The fixed tags in view.

    Raises:
        ConfigError, StorageError: as `open_session`.
        DeviceFault, ConnectionLost: as the camera does.
    """
    frame = cell.camera.read()
    open_session(folder, board, frame, resume=resume)
    return find_tags(frame.color)


def take_views(
    cell: Cell,
    folder: Path,
    held: HeldBoard,
    count: int,
    seed: int,
    progress: CollectionProgress,
    *,
    tags: tuple[FixedTag, ...],
    in_gripper: bool,
    consent: Callable[[], bool],
) -> None:
    """Close the fingers on the board, and take views at planned poses until the session has `count`.

    Args:
        cell: open, configured by `cell_to_calibrate`.
        folder: of the session, which was started.
        held: the board.
        count: how many views.
        seed: of the poses.
        progress: told of every step.
        tags: fixed tags that were in view at the start.
        in_gripper: the gripper holds the board, rather than the flange.
        consent: asked before anything moves; nothing moves if it says no.

    Raises:
        ConfigError: consent was not given.
        CalibrationError: a tag was moved meanwhile, or as `collect`.
        UnsafeMotion, DeviceFault, ConnectionLost, GuardTripped, StorageError: as `collect`.
    """
    if not consent():
        raise ConfigError("nothing was moved")
    if in_gripper:
        _close_on_board(cell)
    collect(cell, folder, held, count, seed, progress)
    # The arm is back where it was, so it hides what it hid then.
    check_tags(cell.camera.read().color, tags)


def solve_session(folder: Path) -> Solution:
    """Solve a session; its folder then has `result.json` and the report.

    Raises:
        ConfigError: this is no session folder, or something in it is wrong.
        StorageError: the folder cannot be written.
    """
    solution = solve(read_session(folder))
    write_whole(folder / "result.json", json.dumps(solution.as_json(), indent=1) + "\n")
    write_report(solution, folder / REPORT, folder)
    return solution


def save_solution(solution: Solution, folder: Path, out: Path, tags: tuple[FixedTag, ...]) -> None:
    """Write the calibration file into the session's folder and to where the cell reads it.

    Args:
        solution: of the session.
        folder: of the session.
        out: the cell's calibration file; one that is better is kept.
        tags: fixed tags that were in view.

    Raises:
        CalibrationError, ConfigError, StorageError: as `save_if_better`.
    """
    for path in (folder / "calibration.json", out):
        save_if_better(solution, path, tags)


def _close_on_board(cell: Cell) -> None:
    grip = Grip("hold the board", closed_width(cell.config), cell.config.gripper.force_n)
    cell.executor.run(check_path(MotionPlan("hold the board", cell.arm.state().q, (grip,)), cell.config))
