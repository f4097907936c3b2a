"""The session folder: what a collection writes and a solver reads.

    session.json        mount, camera, board, when it was started, software
    views/NAME.json     one view: joint angles, poses, corners; written last, so that a view is whole or not there
    views/NAME.png      its colour image
    views/NAME.depth.png  its depth image, 16 bit, in tenths of a millimetre, 0 = no return
    refused/NUMBER.png  images that are of no use: not views, kept to be looked at
    latest.png          the newest image, of use or not, with the corners that were found

An interrupted collection keeps every view that was taken.
"""

from __future__ import annotations

from datetime import datetime, timezone
from importlib.metadata import version
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from pydantic import AwareDatetime, BaseModel, ConfigDict

from calibration.solve.readers.corner_record import CornerRecord, parse_board, views_of_corners
from calibration.solve.readers.validation import validate
from calibration.solve.readers.view_file import read_file
from robotcell.config.calibration_file import CameraModel, CharucoBoard, Mount, PointBoard
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import make_folder, write_whole
from robotcell.io.images import write_image
from robotcell.io.input_file import MEASUREMENTS_MAX_BYTES, read_json

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from calibration.collect.capture import Capture
    from calibration.solve.views import Views
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import RgbdFrame

# Views that do not count lie here, below the folder of the session.
REFUSED = "refused"
# The newest image, with its corners drawn into it.
LATEST = "latest.png"
_HEADER = "session.json"
_VIEWS = "views"
_DEPTH_UNIT_M = 1e-4


class SessionHeader(BaseModel):
    """What holds for all views of a session.

    Attributes:
        version: of this format.
        mount: "fixed": the arm carries the board; "flange": the arm carries the camera.
        camera: device, resolution and intrinsics.
        board: that is looked at.
        started: when.
        software: that wrote it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    version: Literal[1] = 1
    mount: Mount
    camera: CameraModel
    board: CharucoBoard | PointBoard
    started: AwareDatetime
    software: str


class ViewRecord(CornerRecord):
    """One view of a session.

    Attributes:
        taken: when.
        q: joint angles (6,) [rad].
        T_base_tcp: pose of the tool centre point, as the controller stated it; 4x4, metres.
    """

    taken: AwareDatetime
    q: tuple[float, float, float, float, float, float]
    T_base_tcp: list[list[float]]


def open_session(folder: Path, board: CharucoBoard, frame: RgbdFrame, *, resume: bool) -> SessionHeader:
    """Start a session of a fixed camera, or go on with one.

    Args:
        folder: of the session.
        board: that is in the gripper or on the flange.
        frame: of the camera in use.
        resume: there is a session already.

    Raises:
        ConfigError: there is a session already and should not be, or none and should be, or it is of another camera or
            board.
        StorageError: the folder cannot be written.
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


def create_session(folder: Path, header: SessionHeader) -> None:
    """Start a session in a new or empty folder.

    Raises:
        ConfigError: there is a session already.
        StorageError: the folder cannot be written.
    """
    if (folder / _HEADER).exists():
        raise ConfigError(f"{folder}: there is a session already; go on with --resume, or give another folder")
    make_folder(folder / _VIEWS)
    write_whole(folder / _HEADER, header.model_dump_json(indent=1, exclude_none=True) + "\n")


def add_view(
    folder: Path, view: ViewRecord, color: npt.NDArray[np.uint8], depth_m: npt.NDArray[np.float32] | None
) -> None:
    """Add a view to a session, as a whole or not at all. One of the same name is replaced.

    Args:
        folder: of the session.
        view: poses and corners.
        color: (H, W, 3) uint8 RGB.
        depth_m: (H, W) [m], 0 = no return; None without a depth image.

    Raises:
        StorageError: the folder cannot be written.
    """
    views = folder / _VIEWS
    # Packed lightly: the arm waits for it.
    write_image(views / f"{view.name}.png", color, compression=1)
    if depth_m is not None:
        units = np.clip(np.rint(depth_m / _DEPTH_UNIT_M), 0, np.iinfo(np.uint16).max).astype(np.uint16)
        write_image(views / f"{view.name}.depth.png", units, compression=1)
    write_whole(views / f"{view.name}.json", view.model_dump_json(indent=1, exclude_none=True) + "\n")


def add_capture(folder: Path, capture: Capture) -> Views:
    """Add what was captured to a session: a view, or where it is of no use its image among the refused ones.

    Returns:
        The views that the session has now.

    Raises:
        ConfigError: something in the session is wrong.
        StorageError: the folder cannot be written.
    """
    views = read_session(folder)
    write_image(folder / LATEST, capture.picture())
    if capture.detection.refused:
        pictures = folder / REFUSED
        write_image(pictures / f"{1 + len(list(pictures.glob('*.png'))):03d}.png", capture.color)
        return views
    number = 1 + max((int(name) for name in views.names if name.isdecimal()), default=0)
    corners = capture.detection.corners
    record = ViewRecord(
        name=f"{number:03d}",
        T_base_flange=capture.T_base_flange.tolist(),
        ids=corners.ids.tolist(),
        corners_px=[(float(u), float(v)) for u, v in corners.px],
        depth_m=_depth_at(capture.depth_m, corners.px),
        taken=datetime.now(timezone.utc),
        q=tuple(capture.q.tolist()),
        T_base_tcp=capture.T_base_tcp.tolist(),
    )
    add_view(folder, record, capture.color, capture.depth_m)
    return read_session(folder)


def load_header(folder: Path) -> SessionHeader:
    """What holds for all views of a session.

    Raises:
        ConfigError: this is no session folder, or its header is wrong.
    """
    path = folder / _HEADER
    if not path.exists():
        raise ConfigError(f"{folder}: no session folder: it has no {_HEADER}")
    values = read_json(path, MEASUREMENTS_MAX_BYTES)
    if isinstance(values, dict) and values.get("version", 1) != 1:
        raise ConfigError(f"{path}: version {values['version']}; this program reads 1")
    if isinstance(values, dict) and "board" in values:
        parse_board(values["board"], f"{path}: board")
    return validate(SessionHeader, values, str(path))


def load_records(folder: Path) -> list[ViewRecord]:
    """The views of a session by name.

    Raises:
        ConfigError: a file of a view is wrong.
    """
    paths = sorted((folder / _VIEWS).glob("*.json"))
    return [validate(ViewRecord, read_json(path, MEASUREMENTS_MAX_BYTES), str(path)) for path in paths]


def image_path(folder: Path, name: str) -> Path:
    """The colour image of a view."""
    return folder / _VIEWS / f"{name}.png"


def read_session(folder: Path, mount: Mount | None = None) -> Views:
    """The views of a session folder, ready to be solved.

    Args:
        folder: of the session.
        mount: must agree with that of the session, where given.

    Raises:
        ConfigError: this is no session folder, or something in it is wrong.
    """
    header = load_header(folder)
    if mount is not None and mount != header.mount:
        raise ConfigError(f"{folder}: mount is {header.mount} in the session and {mount} on the command line")
    records = load_records(folder)
    date = max((record.taken for record in records), default=header.started)
    return views_of_corners(records, header.mount, header.camera, header.board, date, folder)


def read_views(source: Path, mount: Mount | None = None) -> Views:
    """The views of a session folder, or of another program's pairs.json or corners.json.

    Args:
        source: folder or file.
        mount: where the camera is; must agree with what the source says.

    Raises:
        ConfigError: it cannot be read, or something in it is wrong.
    """
    return read_session(source, mount) if source.is_dir() else read_file(source, mount)


def _depth_at(depth_m: npt.NDArray[np.float32], px: Array) -> list[float]:
    """Mean depth around pixels (n, 2) [m]; 0 where most of them have no return."""
    seen = (depth_m > 0).astype(np.float32)
    total, count = (cv2.boxFilter(image, -1, (3, 3), normalize=False) for image in (depth_m, seen))
    u, v = np.rint(px).astype(int).T
    return [float(t / c) if c > 4 else 0.0 for t, c in zip(total[v, u], count[v, u], strict=True)]
