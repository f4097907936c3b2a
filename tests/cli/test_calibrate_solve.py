from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from calibration.solve.se3 import difference
from cli.main import app
from robotcell.config.calibration_file import load_calibration
from tests.calibration.solve.readers.test_view_file import corners_file, write
from tests.calibration.solve.test_time_alignment import recording
from tests.calibration.solve.test_time_alignment import write as write_series
from tests.calibration.synthetic import as_poses, make_views, to_json

MOVEIT = Path(__file__).parents[1] / "calibration" / "data" / "moveit_pose_samples.json"


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(app, ["calibrate", "solve", *map(str, arguments)])


def test_the_public_pairs_are_accepted() -> None:
    result = run(MOVEIT, "--mount", "fixed", "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert np.linalg.norm(np.array(report["T_base_camera"])[:3, 3] - (0.659, -0.249, 0.830)) < 0.01
    assert report["verdict"]["accepted"] is True
    assert report["rejected_views"] == []


def test_a_person_reads_verdict_and_cure() -> None:
    result = run(MOVEIT, "--mount", "flange")
    assert result.exit_code == 1
    assert result.stdout.startswith("refused: ")
    assert "Give the right --mount" in result.stdout
    result = run(MOVEIT)
    assert result.stdout.startswith("accepted: ")
    assert "T_base_camera" in result.stdout


def test_corners_give_a_calibration_file(tmp_path: Path) -> None:
    views, truth = make_views(0, 20, mount="flange", corner_px=0.1)
    path, out = write(tmp_path / "corners.json", corners_file(views)), tmp_path / "camera.json"
    result = run(path, "--refine-intrinsics", "--json", "--out", out)
    assert result.exit_code == 0
    X = np.array(json.loads(result.stdout)["T_flange_camera"])
    assert np.linalg.norm(difference(X, truth.X)[:3]) < 0.001
    np.testing.assert_array_equal(load_calibration(out).pose(), X)


def test_a_worse_result_leaves_the_file_alone(tmp_path: Path) -> None:
    out = tmp_path / "camera.json"
    for seed, noise, code in ((0, 0.1, 0), (1, 0.6, 1)):
        views, _ = make_views(seed, 20, corner_px=noise)
        result = run(write(tmp_path / "corners.json", corners_file(views)), "--out", out)
        assert result.exit_code == code
    assert "is better" in result.stderr
    assert load_calibration(out).held_out.px.median < 0.5


def test_a_refused_result_writes_nothing(tmp_path: Path) -> None:
    views, truth = make_views(0, 8)
    poses = as_poses(views, truth)
    pairs = [to_json(pair) for pair in zip(poses.T_base_flange, poses.T_camera_board, strict=True)]
    result = run(write(tmp_path / "pairs.json", pairs), "--json", "--out", tmp_path / "camera.json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["verdict"]["reason"] == "too_few_views"
    assert not (tmp_path / "camera.json").exists()


def test_two_time_series(tmp_path: Path) -> None:
    flange, board = recording("fixed", 0.05, seconds=40.0)
    result = run(
        "--flange",
        write_series(tmp_path / "a.csv", flange),
        "--board",
        write_series(tmp_path / "b.csv", board),
        "--json",
    )
    assert result.exit_code == 0
    assert json.loads(result.stdout)["time_offset_s"] == pytest.approx(0.05, abs=0.002)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((), "give either a file or folder of views, or --flange and --board"),
        ((MOVEIT, "--flange", "a.csv", "--board", "b.csv"), "give either"),
        (("--flange", "a.csv"), "--flange and --board belong together"),
        ((MOVEIT, "--mount", "ceiling"), "--mount ceiling: it is fixed or flange"),
        ((MOVEIT, "--refine-intrinsics"), "--refine-intrinsics needs corners"),
        (("nowhere.json",), "nowhere.json: no such file"),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[Any, ...], reason: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert reason in result.stderr


def test_a_folder_that_is_no_session_is_told(tmp_path: Path) -> None:
    result = run(tmp_path)
    assert result.exit_code == 2
    assert "no session folder" in result.stderr.replace("\n", "")
