"""Views from files: pose pairs and corners of other programs. Every mistake names the file, the view and the field.

pairs.json is a list of [T_base_flange, T_camera_board], 4x4 matrices in metres. corners.json holds "mount", "camera",
"board" and "views" (docs/how-to/solve-recorded-data.md shows one). A session folder is read by
`calibration.collect.session`.
"""

from __future__ import annotations

from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.solve.readers.corner_record import CornerRecord, parse_board, parse_pose, views_of_corners
from calibration.solve.readers.validation import validate
from calibration.solve.views import Views
from robotcell.config.calibration_file import CameraModel, Mount
from robotcell.errors import ConfigError
from robotcell.io.input_file import MEASUREMENTS_MAX_BYTES, read_json

if TYPE_CHECKING:
    from pathlib import Path

_MOUNTS = ("fixed", "flange")


def read_file(path: Path, mount: Mount | None = None) -> Views:
    """Read pairs.json or corners.json, whichever it is.

    Args:
        path: of the file.
        mount: where the camera is; "fixed" unless given, and must agree with a file that says it.

    Raises:
        ConfigError: the file cannot be read or is wrong somewhere.
    """
    values = read_json(path, MEASUREMENTS_MAX_BYTES)
    date = datetime.fromtimestamp(path.stat().st_mtime, timezone.utc)
    if isinstance(values, list):
        return _pairs(values, path, mount or "fixed", date)
    if isinstance(values, dict):
        return _corners(values, path, mount, date)
    raise ConfigError(f"{path}: neither a list of pose pairs nor an object with corners")


def _pairs(values: list[Any], path: Path, mount: Mount, date: datetime) -> Views:
    flange, board = [], []
    for i, pair in enumerate(values):
        if not isinstance(pair, list) or len(pair) != 2:
            raise ConfigError(f"{path}: pair {i}: not a list of two matrices, [T_base_flange, T_camera_board]")
        flange.append(parse_pose(pair[0], f"{path}: pair {i}: T_base_flange"))
        board.append(parse_pose(pair[1], f"{path}: pair {i}: T_camera_board"))
    return Views(
        mount=mount,
        names=tuple(f"pair {i}" for i in range(len(values))),
        T_base_flange=np.array(flange).reshape(-1, 4, 4),
        date=date,
        T_camera_board=np.array(board).reshape(-1, 4, 4),
    )


def _corners(values: dict[str, Any], path: Path, mount: Mount | None, date: datetime) -> Views:
    missing = [key for key in ("mount", "camera", "board", "views") if key not in values]
    if missing:
        raise ConfigError(f"{path}: {', '.join(missing)}: missing")
    if values["mount"] not in _MOUNTS:
        raise ConfigError(f'{path}: mount: {values["mount"]!r}; it is "fixed" or "flange"')
    if mount is not None and mount != values["mount"]:
        raise ConfigError(f"{path}: mount is {values['mount']} in the file and {mount} on the command line")
    if not isinstance(values["views"], list):
        raise ConfigError(f"{path}: views: not a list")
    records = []
    for i, view in enumerate(values["views"]):
        name = view.get("name", i) if isinstance(view, dict) else i
        records.append(validate(CornerRecord, view, f"{path}: view {name}"))
    camera = validate(CameraModel, values["camera"], f"{path}: camera")
    board = parse_board(values["board"], f"{path}: board")
    return views_of_corners(records, values["mount"], camera, board, date, path)
