"""Acquires the views of a calibration: goes to planned poses, or waits for the operator who moves the arm.

Every view is in the session folder before the arm moves on, so whatever ends the collection, what was taken is kept.
Motion goes through the path check and the executor like that of a job.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from calibration.collect.board_motion import plan_motions
from calibration.collect.capture import Capture, capture_view
from calibration.collect.running_estimate import RunningEstimate, running_estimate
from calibration.collect.session import REFUSED, add_capture, read_session
from calibration.collect.surroundings import what_stands
from calibration.collect.view_planning import plan_views
from calibration.solve.se3 import difference
from calibration.target.detection import Detector
from calibration.target.held_board import HeldBoard
from robotcell.errors import CalibrationError, UnsafeMotion
from robotcell.geometry.bodies import blocks_view

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from robotcell.cell import Cell
    from robotcell.config.calibration_file import CharucoBoard
    from robotcell.geometry.transforms import Array
    from robotcell.perception.clearance_map import ClearanceMap

# The remaining views are planned again, once, when the camera is found so far from where cell.toml has it.
_PLAN_AGAIN_VIEWS = 8
_PLAN_AGAIN_M, _PLAN_AGAIN_RAD = 0.015, 0.03
# Views that turned out to be of no use are made up for so many times.
_ROUNDS = 4


class CollectionProgress(Protocol):
    """What is told of a collection while it goes on."""

    def moving(self, taken: int, count: int) -> None:
        """The arm goes to the next view; `taken` of `count` are there."""
        ...

    def captured(self, capture: Capture, taken: int, count: int, estimate: RunningEstimate | None) -> None:
        """A view was taken, of use or not, and is on the disk."""
        ...

    def skipped(self, why: str) -> None:
        """A pose was left out, because the way to it is not safe."""
        ...


def collect(cell: Cell, folder: Path, held: HeldBoard, count: int, seed: int, progress: CollectionProgress) -> None:
    """Take views at planned poses until the session has `count`; then go back to where the arm stood.

    Args:
        cell: open, with the board in the gripper or on the flange.
        folder: of the session; views that it holds already count.
        held: the board.
        count: how many views.
        seed: of the plan.
        progress: told of every step.

    Raises:
        UnsafeMotion: no pose shows the board to the camera and is safe.
        CalibrationError: the views stay too few; what was taken is kept.
        DeviceFault, ConnectionLost, GuardTripped: as devices and guard do; what was taken is kept.
    """
    detector = Detector(held.board)
    q_first = cell.arm.state().q
    T_base_camera = cell.config.camera.pose()
    # What stands there stays there: the arm comes back to where it stood for this frame.
    frame, area = cell.camera.read(), cell.config.workspace
    for _ in range(_ROUNDS):
        views = read_session(folder)
        taken = len(views)
        if taken >= count:
            return
        estimate = running_estimate(views)
        if estimate is not None and taken >= _PLAN_AGAIN_VIEWS:
            T_base_camera, held = estimate.T_base_camera, HeldBoard(held.board, estimate.T_flange_board)
        seen = list(np.linalg.inv(T_base_camera) @ views.T_base_flange @ held.T_flange_board)
        standing = None
        if not blocks_view(q_first, T_base_camera[:3, 3], area.x, area.y, cell.config.table.height_m):
            standing = what_stands(frame, q_first, held, T_base_camera, cell.config)
        plan = plan_views(
            cell.config,
            held,
            T_base_camera,
            frame.intrinsics,
            count - taken,
            seed,
            cell.arm.state().q,
            seen,
            standing,
        )
        for q in plan.views:
            progress.moving(taken, count)
            try:
                motions = plan_motions("go to a view", cell.arm.state().q, q, plan.q_via, held, cell.config, standing)
            except UnsafeMotion as error:
                progress.skipped(str(error))
                continue
            for motion in motions:
                cell.executor.run(motion)
            taken, estimate = _take(cell, folder, detector, count, progress)
            if taken == _PLAN_AGAIN_VIEWS and estimate is not None and _is_elsewhere(estimate, T_base_camera):
                break
        else:
            _go_back(cell, q_first, plan.q_via, held, standing, progress)
    if len(read_session(folder)) < count:
        raise CalibrationError(
            f"{len(read_session(folder))} of {count} views show the board: it is not seen where it should be. Look at "
            f"the pictures in {folder / REFUSED}, check the light, the camera's place in cell.toml and how the board "
            "is held, then go on with --resume"
        )


def collect_by_hand(
    cell: Cell, folder: Path, board: CharucoBoard, count: int, ask: Callable[[], bool], progress: CollectionProgress
) -> None:
    """Take a view whenever the operator, who moves the arm by its own freedrive button, asks for one.

    Args:
        cell: open; the arm is not moved.
        folder: of the session; views that it holds already count.
        board: in the gripper or on the flange.
        count: how many views.
        ask: waits for the operator; False ends the collection.
        progress: told of every view.

    Raises:
        DeviceFault, ConnectionLost: as the devices do; what was taken is kept.
    """
    detector = Detector(board)
    taken = len(read_session(folder))
    while taken < count and ask():
        taken, _ = _take(cell, folder, detector, count, progress)


def _is_elsewhere(estimate: RunningEstimate, T_base_camera: Array) -> bool:
    off = difference(estimate.T_base_camera, T_base_camera)
    return bool(np.linalg.norm(off[:3]) > _PLAN_AGAIN_M or np.linalg.norm(off[3:]) > _PLAN_AGAIN_RAD)


def _go_back(
    cell: Cell,
    q_first: Array,
    q_via: Array,
    held: HeldBoard,
    standing: ClearanceMap | None,
    progress: CollectionProgress,
) -> None:
    try:
        motions = plan_motions("go back", cell.arm.state().q, q_first, q_via, held, cell.config, standing)
    except UnsafeMotion as error:
        progress.skipped(str(error))
        return
    for motion in motions:
        cell.executor.run(motion)


def _take(
    cell: Cell, folder: Path, detector: Detector, count: int, progress: CollectionProgress
) -> tuple[int, RunningEstimate | None]:
    """Capture a view, put it on the disk, and say how many there are now and what they say."""
    capture = capture_view(cell, detector)
    views = add_capture(folder, capture)
    estimate = None if capture.detection.refused else running_estimate(views)
    progress.captured(capture, len(views), count, estimate)
    return len(views), estimate
