"""The session folder: what a collection writes and a solver reads.

    session.json        mount, camera, board, when it was started, software
    views/NAME.json     one view: joint angles, poses, corners; written last, so that a view is whole or not there
    views/NAME.png      its colour image
    views/NAME.depth.png  its depth image, 16 bit, in tenths of a millimetre, 0 = no return

An interrupted collection keeps every view that was taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from PIL import Image
from pydantic import AwareDatetime, BaseModel, ConfigDict

from calibration.solve.readers.records import CornerRecord, parse_board, read_json, validate, views_of_corners
from robotcell.config.calibration_file import CameraModel, CharucoBoard, Mount, PointBoard
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import write_whole

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from calibration.solve.views import Views

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


def create_session(folder: Path, header: SessionHeader) -> None:
    """Start a session in a new or empty folder.

    Raises:
        ConfigError: there is a session already, or the folder cannot be written.
    """
    if (folder / _HEADER).exists():
        raise ConfigError(f"{folder}: there is a session already; go on with --resume, or give another folder")
    try:
        (folder / _VIEWS).mkdir(parents=True, exist_ok=True)
        write_whole(folder / _HEADER, header.model_dump_json(indent=1, exclude_none=True) + "\n")
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from error


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
        ConfigError: the folder cannot be written.
    """
    views = folder / _VIEWS
    try:
        # Packed lightly: the arm waits for it.
        Image.fromarray(color).save(views / f"{view.name}.png", compress_level=1)
        if depth_m is not None:
            units = np.clip(np.rint(depth_m / _DEPTH_UNIT_M), 0, np.iinfo(np.uint16).max).astype(np.uint16)
            Image.fromarray(units).save(views / f"{view.name}.depth.png", compress_level=1)
        write_whole(views / f"{view.name}.json", view.model_dump_json(indent=1, exclude_none=True) + "\n")
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from error


def load_header(folder: Path) -> SessionHeader:
    """What holds for all views of a session.

    Raises:
        ConfigError: this is no session folder, or its header is wrong.
    """
    path = folder / _HEADER
    if not path.exists():
        raise ConfigError(f"{folder}: no session folder: it has no {_HEADER}")
    values = read_json(path)
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
    return [validate(ViewRecord, read_json(path), str(path)) for path in paths]


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
