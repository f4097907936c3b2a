from __future__ import annotations

import json
import shlex

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from cli.main import app
from policy.evaluation.suites import SUITES, Case
from policy.evaluation.trials import Trial, run_trial
from robotcell.config import load_config
from tests.policy.evaluation.test_suites import toml


def trial(case: Case, seed: int = 0, cell_file: str | None = None, **settings: object) -> Trial:
    config = load_config(None, {key.replace("__", "."): value for key, value in settings.items()})
    return Trial("challenging", case, seed, "heuristic", config, cell_file)


def test_a_trial_is_the_job_that_its_command_runs(tmp_path):
    cell_file = tmp_path / "cell.toml"
    cell_file.write_text(f'[journal]\nruns = "{tmp_path / "runs"}"\n')
    (tmp_path / "two.toml").write_text(toml(("goal", '"red"'), ("other", '"blue"')))
    case = Case("two.toml", str(tmp_path / "two.toml"), None)
    result, pictures = run_trial(trial(case, 3, str(cell_file)))
    assert (result.completed, result.true_completed, result.objects) == (True, True, 2)
    assert result.grasp_successes == 2
    assert result.actions == result.pushes + result.grasp_attempts
    assert len(pictures) == len(result.shown)
    program, *arguments = shlex.split(result.command)
    assert program == "robotcell"
    again = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert again["simulated_s"] == pytest.approx(result.simulated_s, abs=1e-3)
    assert (again["actions"], again["completed"]) == (result.actions, True)


def test_a_cell_that_stops_is_a_result_with_its_picture(tmp_path):
    (tmp_path / "one.toml").write_text(toml(("goal", '"red"')))
    case = Case("one.toml", str(tmp_path / "one.toml"), "red")
    result, pictures = run_trial(trial(case, limits__force_n=1.0, motion__contact_force_n=1.0))
    assert not result.completed
    assert not result.true_completed
    assert result.failures == {"stopped": 1}
    assert "limit 1 N" in result.reason
    (failure,) = result.shown
    assert failure.result == "stopped"
    picture = cv2.imdecode(np.frombuffer(pictures[failure.picture], np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape[1] == 800


def test_a_cell_that_cannot_be_opened_is_a_result(tmp_path):
    # The object falls off the table before anything starts.
    (tmp_path / "far.toml").write_text(toml(("goal", '"red"')).replace("position = [0.0,", "position = [9.0,"))
    result, pictures = run_trial(trial(Case("far.toml", str(tmp_path / "far.toml"), "red")))
    assert (result.completed, result.failures, pictures) == (False, {"stopped": 1}, {})
    assert result.reason


def test_a_goal_that_is_not_there_is_shown_as_the_table_at_the_end(tmp_path):
    (tmp_path / "one.toml").write_text(toml(("other", '"blue"')))
    result, pictures = run_trial(trial(Case("one.toml", str(tmp_path / "one.toml"), "red")))
    assert not result.completed
    assert "no red object" in result.reason
    assert [failure.result for failure in result.shown] == ["not complete"]
    assert list(pictures) == ["challenging-one.toml-0-heuristic-1.jpg"]
    assert result.decision_s is None


def test_a_drawn_scene_whose_goal_lies_buried_is_drawn_anew():
    case = SUITES["random"].cases[0]
    # Under the heap of seed 0 no red is seen. The limit ends the job at the first contact.
    result, _ = run_trial(trial(case, 0, limits__force_n=1.0, motion__contact_force_n=1.0))
    assert result.seed == 0
    assert result.scene_seed == 1_000_000
    assert "--seed 1000000" in result.command
    assert result.objects == 30


def test_of_many_failures_the_first_two_and_the_last_are_shown(tmp_path):
    (tmp_path / "one.toml").write_text(toml(("goal", '"red"')))
    # Whatever is tried is refused: the arm is kept out of where the goal stands.
    shelf = {"name": "shelf", "x": (-0.65, -0.35), "y": (-0.15, 0.15), "z": (0.0, 0.15)}
    case = Case("one.toml", str(tmp_path / "one.toml"), "red")
    result, pictures = run_trial(trial(case, keep_out=[shelf]))
    assert set(result.failures) == {"refused"}
    assert sum(result.failures.values()) > 3
    assert [failure.action.split(".")[0] for failure in result.shown][:2] == ["1", "2"]
    assert int(result.shown[2].action.split(".")[0]) > 3
    assert {failure.picture for failure in result.shown} == set(pictures)
    assert len(pictures) == 3
