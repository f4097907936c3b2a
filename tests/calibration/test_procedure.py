"""What `procedure` does before and after the views; the whole of it is in tests/cli/test_calibrate.py."""

import json

import numpy as np
import pytest

from calibration.procedure import REPORT, cell_to_calibrate, save_solution, solve_session, start_session, take_views
from calibration.solve.pipeline import solve
from calibration.solve.saving import save_if_better
from calibration.target.held_board import HeldBoard
from robotcell.config import load_config
from robotcell.config.calibration_file import load_calibration
from robotcell.errors import ConfigError, StorageError
from robotcell.perception.board_plate import DEFAULT_BOARD, held_by_gripper
from sim_twin.devices.backend import open_twin
from tests.calibration.recorded import write_session
from tests.calibration.synthetic import make_views


def test_a_stale_calibration_is_left_aside_and_its_pose_is_the_guess(tmp_path):
    solution = solve(make_views(0, 12, corner_px=0.1)[0])
    save_if_better(solution, tmp_path / "old.json")
    devices = {
        "backend.name": "hardware",
        "backend.options.arm.host": "10.0.0.1",
        "backend.options.gripper.host": "10.0.0.2",
    }
    config = load_config(None, {"camera.calibration": str(tmp_path / "old.json"), **devices})
    found = cell_to_calibrate(config, DEFAULT_BOARD, in_gripper=True)
    assert found.camera.measured is None
    np.testing.assert_allclose(found.camera.pose(), solution.estimate.X)


def test_the_twin_gets_its_board_and_has_no_other():
    found = cell_to_calibrate(load_config(), DEFAULT_BOARD, in_gripper=True)
    assert found.backend.options["board"] is True
    for board, in_gripper in ((DEFAULT_BOARD.model_copy(update={"square_m": 0.029}), True), (DEFAULT_BOARD, False)):
        with pytest.raises(ConfigError, match="the twin holds the default board"):
            cell_to_calibrate(load_config(), board, in_gripper=in_gripper)


def test_nothing_moves_without_consent(tmp_path):
    config = cell_to_calibrate(load_config(None, {"backend.options.objects": 1}), DEFAULT_BOARD, in_gripper=True)
    with open_twin(config)[0] as cell:
        tags = start_session(cell, tmp_path / "session", DEFAULT_BOARD, resume=False)
        before = cell.arm.state().q, cell.gripper.state().width_m
        with pytest.raises(ConfigError, match="nothing was moved"):
            take_views(
                cell,
                tmp_path / "session",
                HeldBoard(DEFAULT_BOARD, held_by_gripper(DEFAULT_BOARD)),
                12,
                0,
                None,
                tags=tags,
                in_gripper=True,
                consent=lambda: False,
            )
        assert np.array_equal(cell.arm.state().q, before[0])
        assert cell.gripper.state().width_m == before[1]


@pytest.fixture
def session(tmp_path):
    write_session(tmp_path / "session", make_views(0, 12, corner_px=0.1)[0])
    return tmp_path / "session"


def test_a_session_is_solved_reported_and_saved_twice(session, tmp_path):
    solution = solve_session(session)
    assert json.loads((session / "result.json").read_text()) == json.loads(json.dumps(solution.as_json()))
    assert solution.verdict.words in (session / REPORT).read_text()
    save_solution(solution, session, tmp_path / "camera.json", ())
    assert load_calibration(tmp_path / "camera.json") == load_calibration(session / "calibration.json")


def test_a_disk_that_cannot_be_written_is_a_storage_error(session):
    (session / "result.json").mkdir()
    with pytest.raises(StorageError, match=r"result\.json"):
        solve_session(session)
