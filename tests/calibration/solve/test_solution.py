from __future__ import annotations

import json
from dataclasses import replace
from datetime import timedelta
from typing import TYPE_CHECKING

import numpy as np
import pytest

from calibration.solve.pipeline import solve
from calibration.solve.saving import save_if_better
from robotcell.config import load_config
from robotcell.config.calibration_file import load_calibration
from robotcell.errors import CalibrationError, ConfigError
from tests.calibration.synthetic import as_poses, make_views

if TYPE_CHECKING:
    from pathlib import Path

    from calibration.solve.solution import Solution
    from calibration.solve.views import Views


@pytest.fixture(scope="module")
def quiet() -> Solution:
    return solve(make_views(0, 20, corner_px=0.1, position_m=0.0001, rotation_rad=0.0001)[0])


@pytest.fixture(scope="module")
def loud() -> Solution:
    return solve(make_views(1, 14, corner_px=0.4, position_m=0.0005, rotation_rad=0.0005)[0])


@pytest.fixture(scope="module")
def flange() -> Solution:
    return solve(make_views(0, 20, mount="flange", corner_px=0.1)[0])


@pytest.fixture(scope="module")
def refused() -> Solution:
    return solve(make_views(0, 8)[0])


def again(solution: Solution, **changes: object) -> Solution:
    """The same result of other views."""
    views: Views = replace(solution.views, **changes)  # type: ignore[arg-type]
    return replace(solution, views=views)


def test_the_cell_can_use_what_was_found(tmp_path: Path, quiet: Solution) -> None:
    path = tmp_path / "camera.json"
    save_if_better(quiet, path)
    calibration = load_calibration(path)
    np.testing.assert_array_equal(calibration.pose(), quiet.estimate.X)
    assert calibration.camera == quiet.views.camera
    assert calibration.board == quiet.views.board
    assert calibration.date == quiet.views.date
    assert calibration.held_out.px == quiet.spread("px")
    np.testing.assert_allclose(calibration.covariance, quiet.estimate.covariance)
    config = load_config(None, {"camera.calibration": str(path)})
    np.testing.assert_array_equal(config.camera.pose(), quiet.estimate.X)


def test_a_camera_on_the_flange_has_its_own_transforms(tmp_path: Path, flange: Solution) -> None:
    save_if_better(flange, tmp_path / "camera.json")
    calibration = load_calibration(tmp_path / "camera.json")
    assert calibration.T_base_camera is None
    np.testing.assert_array_equal(calibration.T_flange_camera, flange.estimate.X)
    np.testing.assert_array_equal(calibration.T_base_board, flange.estimate.Z)


def test_a_refused_result_is_never_written(tmp_path: Path, refused: Solution) -> None:
    with pytest.raises(CalibrationError, match="refused"):
        save_if_better(refused, tmp_path / "camera.json")
    assert not (tmp_path / "camera.json").exists()


def test_poses_alone_name_no_camera(tmp_path: Path) -> None:
    views, truth = make_views(0, 20)
    with pytest.raises(ConfigError, match="poses alone do not say which camera"):
        save_if_better(solve(as_poses(views, truth, position_m=0.0002, rotation_rad=0.0002)), tmp_path / "camera.json")


def test_a_worse_result_does_not_replace_a_better_one(tmp_path: Path, quiet: Solution, loud: Solution) -> None:
    path = tmp_path / "camera.json"
    save_if_better(quiet, path)
    before = path.read_text()
    with pytest.raises(CalibrationError, match=r"is better \(20 views.*was kept"):
        save_if_better(loud, path)
    assert path.read_text() == before
    save_if_better(quiet, path)  # an equal one is newer


def test_a_better_result_replaces_a_worse_one(tmp_path: Path, quiet: Solution, loud: Solution) -> None:
    path = tmp_path / "camera.json"
    save_if_better(loud, path)
    save_if_better(quiet, path)
    np.testing.assert_array_equal(load_calibration(path).pose(), quiet.estimate.X)


def test_what_is_of_another_camera_or_of_long_ago_is_not_better(
    tmp_path: Path, quiet: Solution, loud: Solution, flange: Solution
) -> None:
    path = tmp_path / "camera.json"
    save_if_better(quiet, path)
    save_if_better(again(loud, date=loud.views.date + timedelta(days=200)), path)
    np.testing.assert_array_equal(load_calibration(path).pose(), loud.estimate.X)
    save_if_better(flange, path)
    assert load_calibration(path).mount == "flange"


def test_a_strange_file_is_not_overwritten(tmp_path: Path, quiet: Solution) -> None:
    path = tmp_path / "camera.json"
    path.write_text("my notes")
    with pytest.raises(ConfigError, match="not a JSON file"):
        save_if_better(quiet, path)
    assert path.read_text() == "my notes"


def test_json_says_everything(quiet: Solution, flange: Solution, refused: Solution) -> None:
    report = json.loads(json.dumps(quiet.as_json()))
    assert np.array(report["T_base_camera"]).shape == np.array(report["T_flange_board"]).shape == (4, 4)
    assert report["verdict"]["accepted"] is True
    for unit in ("mm", "deg", "px"):
        errors = report["held_out"][unit]
        assert 0 < errors["median"] <= errors["p95"]
        assert list(errors["per_view"]) == list(quiet.views.names)
        assert np.mean(list(errors["per_view"].values())) == pytest.approx(errors["mean"])
    assert report["time_offset_s"] is None
    assert np.array(report["covariance"]).shape == (6, 6)
    assert {"T_flange_camera", "T_base_board"} <= flange.as_json().keys()
    nothing = refused.as_json()
    assert nothing["T_base_camera"] is None
    assert nothing["verdict"]["reason"] == "too_few_views"
    assert nothing["held_out"] == {"mm": None, "deg": None, "px": None}
