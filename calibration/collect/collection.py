"""Takes the views of a calibration: goes to planned poses, or waits for the operator who moves the arm.

Every view is in the session folder before the arm moves on, so whatever ends the collection, what was taken is kept.
Motion goes through the safety layer and the executor like that of a job.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import version
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from calibration.collect.capture import Shot, take_shot
from calibration.collect.planning import HeldBoard, plan_views, plan_ways
from calibration.collect.session import SessionHeader, ViewRecord, add_view, create_session, load_header, read_session
from calibration.solve.board_pose import refine_poses, start_poses, usable_corners
from calibration.solve.consensus import find_consensus
from calibration.solve.projection import intrinsics_vector, stack_corners
from calibration.solve.rigid import difference
from calibration.target.detection import Detector
from robotcell.config.calibration_file import CameraModel, CharucoBoard
from robotcell.errors import CalibrationError, ConfigError, UnsafeMotion
from robotcell.geometry.transforms import Array, make_transform
from robotcell.motion.executor import Executor

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy.typing as npt

    from calibration.solve.views import Views
    from robotcell.cell import Cell
    from robotcell.interfaces import RgbdFrame

# Views that do not count lie here, below the folder of the session.
REFUSED = "refused"
# Before these, an estimate says nothing.
_ESTIMATE_VIEWS = 5
# The remaining views are planned again, once, when the camera is found so far from where cell.toml has it.
_PLAN_AGAIN_VIEWS = 8
_PLAN_AGAIN_M, _PLAN_AGAIN_RAD = 0.015, 0.03
# Views that turned out to be of no use are made up for so many times.
_ROUNDS = 4


@dataclass(frozen=True)
class RunningEstimate:
    """What the views so far say.

    Attributes:
        T_base_camera: (4, 4).
        T_flange_board: (4, 4).
        disagreement_m: by which the median view disagrees, turns at a lever counted in.
    """

    T_base_camera: Array
    T_flange_board: Array
    disagreement_m: float


class Follower(Protocol):
    """Follows a collection."""

    def going(self, taken: int, count: int) -> None:
        """The arm goes to the next view; `taken` of `count` are there."""
        ...

    def took(self, shot: Shot, taken: int, count: int, estimate: RunningEstimate | None) -> None:
        """A view was taken, of use or not, and is on the disk."""
        ...

    def skipped(self, why: str) -> None:
        """A pose was left out, because the way to it is not safe."""
        ...


def open_session(folder: Path, board: CharucoBoard, frame: RgbdFrame, *, resume: bool) -> SessionHeader:
    """Start a session of a fixed camera, or go on with one.

    Args:
        folder: of the session.
        board: that is in the gripper or on the flange.
        frame: of the camera in use.
        resume: there is a session already.

    Raises:
        ConfigError: there is a session already and should not be, or none and should be, or it is of another camera or
            board; or the folder cannot be written.
    """
    header = SessionHeader(
        mount="fixed",
        camera=camera_model(frame),
        board=board,
        started=datetime.now(timezone.utc),
        software=f"robotcell {version('robotcell')}",
    )
    if not resume:
        create_session(folder, header)
        return header
    before = load_header(folder)
    for what in ("mount", "camera", "board"):
        if getattr(before, what) != getattr(header, what):
            raise ConfigError(
                f"{folder}: its {what} is {getattr(before, what)!r} and {getattr(header, what)!r} is in use: start a "
                "session of its own"
            )
    return before


def camera_model(frame: RgbdFrame) -> CameraModel:
    """The camera of a frame, whose images have no distortion."""
    optics = frame.intrinsics
    return CameraModel(
        serial=frame.serial,
        width=optics.width,
        height=optics.height,
        fx=optics.fx,
        fy=optics.fy,
        cx=optics.cx,
        cy=optics.cy,
    )


def collect(cell: Cell, folder: Path, held: HeldBoard, count: int, seed: int, follower: Follower) -> None:
    """Take views at planned poses until the session has `count`; then go back to where the arm stood.

    Args:
        cell: open, with the board in the gripper or on the flange.
        folder: of the session; views that it holds already count.
        held: the board.
        count: how many views.
        seed: of the plan.
        follower: told of every step.

    Raises:
        UnsafeMotion: no pose shows the board to the camera and is safe.
        CalibrationError: the views stay too few; what was taken is kept.
        DeviceFault, ConnectionLost, GuardTripped: as devices and guard do; what was taken is kept.
    """
    detector, executor = Detector(held.board), Executor(cell)
    q_first = cell.arm.state().q
    T_base_camera = cell.config.camera.pose()
    intrinsics = cell.camera.read().intrinsics
    for _ in range(_ROUNDS):
        views = read_session(folder)
        taken = len(views)
        if taken >= count:
            return
        estimate = running_estimate(views)
        if estimate is not None and taken >= _PLAN_AGAIN_VIEWS:
            T_base_camera, held = estimate.T_base_camera, HeldBoard(held.board, estimate.T_flange_board)
        seen = list(np.linalg.inv(T_base_camera) @ views.T_base_flange @ held.T_flange_board)
        plan = plan_views(cell.config, held, T_base_camera, intrinsics, count - taken, seed, cell.arm.state().q, seen)
        for q in plan.views:
            follower.going(taken, count)
            try:
                ways = plan_ways("go to a view", cell.arm.state().q, q, plan.hub, held, cell.config)
            except UnsafeMotion as error:
                follower.skipped(str(error))
                continue
            for way in ways:
                executor.run(way)
            taken, estimate = _take(cell, folder, detector, count, follower)
            if taken == _PLAN_AGAIN_VIEWS and estimate is not None and _is_elsewhere(estimate, T_base_camera):
                break
        else:
            _go_back(cell, executor, q_first, plan.hub, held, follower)
    if len(read_session(folder)) < count:
        raise CalibrationError(
            f"{len(read_session(folder))} of {count} views show the board: it is not seen where it should be. Look at "
            f"the pictures in {folder / REFUSED}, check the light, the camera's place in cell.toml and how the board "
            "is held, then go on with --resume"
        )


def collect_by_hand(
    cell: Cell, folder: Path, board: CharucoBoard, count: int, ask: Callable[[], bool], follower: Follower
) -> None:
    """Take a view whenever the operator, who moves the arm by its own freedrive button, asks for one.

    Args:
        cell: open; the arm is not moved.
        folder: of the session; views that it holds already count.
        board: in the gripper or on the flange.
        count: how many views.
        ask: waits for the operator; False ends the collection.
        follower: told of every view.

    Raises:
        DeviceFault, ConnectionLost: as the devices do; what was taken is kept.
    """
    detector = Detector(board)
    taken = len(read_session(folder))
    while taken < count and ask():
        taken, _ = _take(cell, folder, detector, count, follower)


def running_estimate(views: Views) -> RunningEstimate | None:
    """What the views so far say, in closed form; None where they are too few."""
    if views.corners is None or views.board is None or views.camera is None or not len(views):
        return None
    stack, intrinsics = stack_corners(views.corners, views.board.corners()), intrinsics_vector(views.camera)
    index = np.flatnonzero(usable_corners(stack))
    if len(index) < _ESTIMATE_VIEWS:
        return None
    stack = stack.subset(index)
    poses = refine_poses(stack, intrinsics, start_poses(stack, intrinsics))
    found = find_consensus(views.T_parent_child[index], poses.T_camera_board)
    return RunningEstimate(found.X, found.Z @ make_transform(np.eye(3), -stack.center), found.score)


def _take(
    cell: Cell, folder: Path, detector: Detector, count: int, follower: Follower
) -> tuple[int, RunningEstimate | None]:
    """Take a view, put it on the disk, and say how many there are now and what they say."""
    shot = take_shot(cell, detector)
    before = read_session(folder)
    pictures = folder / REFUSED
    number = 1 + max((int(name) for name in before.names if name.isdecimal()), default=0)
    if shot.detection.refused:
        pictures.mkdir(exist_ok=True)
        number = 1 + len(list(pictures.glob("*.png")))
        _write_picture(pictures / f"{number:03d}.png", shot.color)
        follower.took(shot, len(before), count, None)
        return len(before), None
    corners = shot.detection.corners
    record = ViewRecord(
        name=f"{number:03d}",
        T_base_flange=shot.T_base_flange.tolist(),
        ids=corners.ids.tolist(),
        corners_px=[(float(u), float(v)) for u, v in corners.px],
        depth_m=_depth_at(shot.depth_m, corners.px),
        taken=datetime.now(timezone.utc),
        q=tuple(shot.q.tolist()),
        T_base_tcp=shot.T_base_tcp.tolist(),
    )
    add_view(folder, record, shot.color, shot.depth_m)
    views = read_session(folder)
    estimate = running_estimate(views)
    follower.took(shot, len(views), count, estimate)
    return len(views), estimate


def _depth_at(depth_m: npt.NDArray[np.float32], px: Array) -> list[float]:
    """Mean depth around pixels (n, 2) [m]; 0 where most of them have no return."""
    seen = (depth_m > 0).astype(np.float32)
    total, count = (cv2.boxFilter(image, -1, (3, 3), normalize=False) for image in (depth_m, seen))
    u, v = np.rint(px).astype(int).T
    return [float(t / c) if c > 4 else 0.0 for t, c in zip(total[v, u], count[v, u], strict=True)]


def _is_elsewhere(estimate: RunningEstimate, T_base_camera: Array) -> bool:
    off = difference(estimate.T_base_camera, T_base_camera)
    return bool(np.linalg.norm(off[:3]) > _PLAN_AGAIN_M or np.linalg.norm(off[3:]) > _PLAN_AGAIN_RAD)


def _go_back(cell: Cell, executor: Executor, q_first: Array, hub: Array, held: HeldBoard, follower: Follower) -> None:
    try:
        ways = plan_ways("go back", cell.arm.state().q, q_first, hub, held, cell.config)
    except UnsafeMotion as error:
        follower.skipped(str(error))
        return
    for way in ways:
        executor.run(way)


def _write_picture(path: Path, color: npt.NDArray[np.uint8]) -> None:
    if not cv2.imwrite(str(path), cv2.cvtColor(color, cv2.COLOR_RGB2BGR)):
        raise ConfigError(f"{path}: cannot be written: check the disk")
