"""The whole way from the command line, in the twin: calibrate, believe it, verify it, notice when it no longer fits."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.solve.se3 import difference
from cli.main import app
from robotcell.config import load_config
from robotcell.config.calibration_file import load_calibration
from sim_twin.options import TwinOptions

OFFSET = [0.009, -0.007, 0.006, 0.006, -0.008, 0.010]
CELL = """
[camera]
{camera}
[journal]
runs = "{runs}"
[motion]
joint_acceleration_rad_s2 = 4.0
[backend.options]
objects = 3
tag = true
camera_offset = {offset}
"""


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def write_cell(folder, name="cell.toml", camera="", offset=OFFSET):
    path = folder / name
    path.write_text(CELL.format(camera=camera, runs=folder / "runs", offset=offset))
    return path


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A cell that was calibrated with a few more views than are needed, and what the command said."""
    folder = tmp_path_factory.mktemp("cell")
    done = run("calibrate", "--cell", write_cell(folder), "--views", 14, "--seed", 3, "--out", folder / "camera.json")
    return folder, done


def test_the_camera_is_found_and_everything_is_written(calibrated):
    folder, done = calibrated
    assert done.exit_code == 0, done.output
    assert "accepted" in done.output
    config = load_config(folder / "cell.toml")
    truth = TwinOptions.model_validate(config.backend.options).camera_pose(config.camera)
    found = load_calibration(folder / "camera.json")
    off = difference(found.pose(), truth)
    assert np.linalg.norm(off[:3]) < 0.0007
    assert np.degrees(np.linalg.norm(off[3:])) < 0.05
    assert found.views >= 12
    assert [tag.id for tag in found.tags] == [7]
    (session,) = (folder / "runs" / "calibration").iterdir()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d-\d{6}", session.name)
    for name in ("session.json", "report.html", "result.json", "calibration.json", "latest.png"):
        assert (session / name).exists(), name
    assert json.loads((session / "result.json").read_text())["verdict"]["accepted"]
    assert '[camera]\ncalibration = "camera.json"' in done.output


def test_going_on_with_a_session_that_is_complete_only_solves_again(calibrated):
    folder, _ = calibrated
    (session,) = (folder / "runs" / "calibration").iterdir()
    before = sorted(path.name for path in (session / "views").iterdir())
    cell = folder / "cell.toml"
    again = run("calibrate", "--cell", cell, "--views", 14, "--resume", session, "--out", folder / "again.json")
    assert again.exit_code == 0, again.output
    assert sorted(path.name for path in (session / "views").iterdir()) == before
    np.testing.assert_allclose(
        load_calibration(folder / "again.json").pose(), load_calibration(folder / "camera.json").pose()
    )


def test_the_table_confirms_the_calibration(calibrated):
    folder, _ = calibrated
    cell = write_cell(folder, "believed.toml", 'calibration = "camera.json"')
    done = run("calibrate", "verify", "--cell", cell, "--touch", "--points", 2, "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["ok"]
    assert abs(found["table"]["offset_mm"]) < 1
    assert found["table"]["tilt_deg"] < 0.3
    assert len(found["spots"]) == 2
    for spot in found["spots"]:
        assert abs(spot["difference_mm"]) < 2


def test_without_the_calibration_the_same_cell_is_refused(calibrated):
    folder, _ = calibrated
    done = run("calibrate", "verify", "--cell", folder / "cell.toml", "--json")
    assert done.exit_code == 1
    error = json.loads(done.stdout)
    assert error["code"] == "calibration"
    assert "table" in error["error"]


def test_a_camera_that_was_moved_since_stops_the_job_before_anything_moves(calibrated):
    folder, _ = calibrated
    moved = [OFFSET[0] + 0.004, *OFFSET[1:]]
    cell = write_cell(folder, "moved.toml", 'calibration = "camera.json"', moved)
    done = run("pick", "--all", "--dry-run", "--cell", cell)
    assert done.exit_code == 3
    assert "tag 7 has moved" in done.output
    assert "calibrate again" in done.output


def test_a_calibration_of_another_mode_of_the_camera_is_refused(calibrated):
    folder, _ = calibrated
    cell = write_cell(folder, "mode.toml", 'calibration = "camera.json"\nresolution = "1280x720"')
    done = run("pick", "--all", "--dry-run", "--cell", cell)
    assert done.exit_code == 3
    assert "it is of 640x480, and 1280x720 is in use" in done.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--held-by", "rope"], "gripper or flange"),
        (["--marker-mm", "40"], "marker_m must be below square_m"),
        (["--square-mm", "29"], "the twin holds the default board"),
        (["--resume", "nowhere"], "no session folder"),
        (["--set", "table.colour=1"], "--set table.colour"),
    ],
)
def test_wrong_usage_is_refused_before_anything_moves(tmp_path, arguments, words):
    done = run("calibrate", "--cell", write_cell(tmp_path), "--out", tmp_path / "out.json", *arguments)
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert not (tmp_path / "out.json").exists()


def test_the_board_is_written_as_a_page(tmp_path):
    done = run("calibrate", "board", "--pdf", tmp_path / "board.pdf")
    assert done.exit_code == 0
    assert "A4" in done.output
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


def test_the_shipped_calibration_is_that_of_the_shipped_cell():
    from pathlib import Path

    config = load_config(Path(__file__).parents[2] / "examples" / "cell.toml")
    truth = TwinOptions.model_validate(config.backend.options).camera_pose(config.camera)
    off = difference(config.camera.pose(), truth)
    assert config.camera.measured is not None
    assert 0 < np.linalg.norm(off[:3]) < 0.0007
    assert np.degrees(np.linalg.norm(off[3:])) < 0.05
    # Without it, the program would be off by far more.
    assert np.linalg.norm(difference(config.camera.nominal(), truth)[:3]) > 0.01
