from __future__ import annotations

import json
import pickle
from datetime import datetime, timedelta, timezone
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.config.calibration_file import (
    CameraCalibration,
    CharucoBoard,
    PointBoard,
    load_calibration,
    save_calibration,
)
from robotcell.config import CameraMount, load_config
from robotcell.errors import CalibrationError, ConfigError
from robotcell.geometry.transforms import look_at, make_transform

if TYPE_CHECKING:
    from pathlib import Path

DATE = datetime(2026, 3, 1, 12, 0, tzinfo=timezone.utc)
T_BASE_CAMERA = look_at((-0.8, 0.1, 0.7), (-0.5, 0.0, 0.0))
T_FLANGE_BOARD = make_transform(np.eye(3), (0.0, 0.1, 0.05))
BOARD = {"squares_x": 7, "squares_y": 5, "square_m": 0.04, "marker_m": 0.03, "dictionary": "DICT_5X5_100"}


def values(**changes: Any) -> dict[str, Any]:
    spread = {"mean": 0.5, "median": 0.4, "p95": 1.1}
    return {
        "version": 1,
        "mount": "fixed",
        "T_base_camera": T_BASE_CAMERA.tolist(),
        "T_flange_board": T_FLANGE_BOARD.tolist(),
        "covariance": np.diag([1e-8] * 3 + [1e-9] * 3).tolist(),
        "camera": {"serial": "018322070101", "width": 1280, "height": 720, "fx": 926, "fy": 926, "cx": 640, "cy": 360},
        "board": BOARD,
        "date": DATE.isoformat(),
        "views": 20,
        "rejected": ["view_07"],
        "held_out": {"mm": spread, "deg": spread, "px": spread},
        "method": "Shah, then bundle",
        "software": "robotcell 0.1.0",
        **changes,
    }


@pytest.fixture
def calibration() -> CameraCalibration:
    return CameraCalibration.model_validate(values())


def write(path: Path, **changes: Any) -> Path:
    path.write_text(json.dumps(values(**changes)))
    return path


def test_what_is_saved_is_what_is_loaded(tmp_path: Path, calibration: CameraCalibration) -> None:
    path = tmp_path / "new folder" / "camera.json"
    save_calibration(calibration, path)
    assert load_calibration(path) == calibration
    np.testing.assert_array_equal(load_calibration(path).pose(), T_BASE_CAMERA)
    assert [file.name for file in path.parent.iterdir()] == ["camera.json"]


def test_a_failed_save_leaves_the_old_file(
    tmp_path: Path, calibration: CameraCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "camera.json")
    before = path.read_text()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ConfigError, match="cannot be written: No space left"):
        save_calibration(calibration, path)
    assert path.read_text() == before


def test_of_the_camera_on_the_flange() -> None:
    flange = values(
        mount="flange",
        T_base_camera=None,
        T_flange_board=None,
        T_flange_camera=T_FLANGE_BOARD.tolist(),
        T_base_board=T_BASE_CAMERA.tolist(),
    )
    np.testing.assert_array_equal(CameraCalibration.model_validate(flange).pose(), T_FLANGE_BOARD)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"T_base_camera": None}, 'file: mount "fixed" needs T_base_camera'),
        ({"T_base_board": np.eye(4).tolist()}, 'mount "fixed" has no T_base_board'),
        ({"T_base_camera": np.diag([1, 1, -1, 1]).tolist()}, "T_base_camera: the matrix is mirrored"),
        ({"covariance": np.diag([1, 1, 1, 1, 1, -1]).tolist()}, "covariance: not a covariance"),
        ({"date": "2026-03-01T12:00:00"}, "date: Input should have timezone info"),
        (
            {"camera": {"width": 640, "height": 480, "fx": 0, "fy": 1, "cx": 1, "cy": 1}},
            "camera.fx: Input should be gr",
        ),
        ({"board": BOARD | {"marker_m": 0.05}}, "marker_m must be below square_m"),
        ({"serial": "1"}, "serial: Extra inputs are not permitted"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_calibration(write(tmp_path / "camera.json", **changes))
    assert str(tmp_path) in str(caught.value)
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "not a JSON file"),
        ("[]", "not a calibration file: it has no version"),
        ('{"version": 2}', "version 2; this program reads 1"),
    ],
)
def test_a_file_of_something_else_says_so(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_calibration(path)


def test_a_missing_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file; make one with robotcell calibrate"):
        load_calibration(tmp_path / "camera.json")


def test_it_fits_its_own_camera(calibration: CameraCalibration) -> None:
    calibration.check(serial="018322070101", resolution=(1280, 720), now=DATE + timedelta(days=3))


@pytest.mark.parametrize(
    ("use", "reason"),
    [
        ({"serial": "9"}, "of the camera 018322070101, and 9 is in use"),
        ({"resolution": (640, 480)}, "of 1280x720, and 640x480 is in use"),
        ({"now": DATE + timedelta(days=200)}, "200 days old, and 180 are allowed"),
        ({"now": DATE - timedelta(days=5)}, "dated 2026-03-01, after today"),
    ],
)
def test_it_is_refused_for_another_camera_or_time(
    calibration: CameraCalibration, use: dict[str, Any], reason: str
) -> None:
    with pytest.raises(CalibrationError, match=reason):
        calibration.check(**({"now": DATE} | use))


def test_the_cell_takes_its_camera_from_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "camera.json")
    config = load_config(None, {"camera.calibration": str(path)})
    np.testing.assert_array_equal(config.camera.pose(), T_BASE_CAMERA)
    assert config.camera.measured == load_calibration(path)
    # Worker processes get the cell by pickle, and must not need the file.
    path.unlink()
    copy = pickle.loads(pickle.dumps(config))
    assert copy == config
    np.testing.assert_array_equal(copy.camera.pose(), T_BASE_CAMERA)


def test_without_a_file_nothing_is_measured() -> None:
    assert CameraMount().measured is None


def test_the_cell_refuses_two_poses_and_other_mounts(tmp_path: Path) -> None:
    path = write(tmp_path / "camera.json")
    with pytest.raises(ConfigError, match="calibration and T_base_camera both say where the camera stands"):
        load_config(None, {"camera.calibration": str(path), "camera.T_base_camera": T_BASE_CAMERA.tolist()})
    write(
        path,
        mount="flange",
        T_base_camera=None,
        T_flange_board=None,
        T_flange_camera=T_FLANGE_BOARD.tolist(),
        T_base_board=T_BASE_CAMERA.tolist(),
    )
    with pytest.raises(ConfigError, match="of a camera on the flange; the cell's camera is fixed"):
        load_config(None, {"camera.calibration": str(path)})
    with pytest.raises(ConfigError, match="no such file"):
        load_config(None, {"camera.calibration": str(tmp_path / "other.json")})


@given(st.integers(3, 12), st.integers(3, 12))
def test_corners_are_where_opencv_has_them(squares_x: int, squares_y: int) -> None:
    board = CharucoBoard(squares_x=squares_x, squares_y=squares_y, **{k: BOARD[k] for k in list(BOARD)[2:]})  # type: ignore[arg-type]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    theirs = cv2.aruco.CharucoBoard((squares_x, squares_y), 0.04, 0.03, dictionary).getChessboardCorners()
    corners = board.corners()
    assert list(corners) == list(range(len(theirs)))
    np.testing.assert_allclose(list(corners.values()), theirs, atol=1e-6)


def test_a_board_of_points_keeps_its_ids() -> None:
    points = {4: (0.0, 0.0, 0.0), 9: (0.1, 0.0, 0.0), 1: (0.0, 0.1, 0.0), 2: (0.1, 0.1, 0.02)}
    board = PointBoard.model_validate({"points": {str(k): v for k, v in points.items()}})
    assert board.corners() == points
