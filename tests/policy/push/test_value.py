"""What pushes are good for."""

import numpy as np
import pytest

from policy.push.border import USEFUL_GAIN
from policy.push.outcome import PushForwardModel
from policy.push.value import evaluate_pushes
from robotcell.config import CellConfig
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal, Uncover
from robotcell.motion.push import push_in_workspace
from tests.robotcell.maps import heightmap

CONFIG = CellConfig()
PUSH_M = CONFIG.motion.push_m


def look(*corners, task=None, barred=()):
    """Cubes of 50 mm by their first row and column; `task` is made of the cells of the first."""
    heights, labels = np.zeros((224, 224), np.float32), np.zeros((224, 224), np.int32)
    for label, (row, col) in enumerate(corners, start=1):
        place = slice(row, row + 25), slice(col, col + 25)
        heights[place], labels[place] = 0.05, label
    return Observation(heightmap(heights), labels, PickAny() if task is None else task(labels == 1), barred)


def evaluate(observation, value=lambda cells: np.zeros(cells.shape, np.float32)):
    model = PushForwardModel(observation.labels, observation.heightmap)
    return evaluate_pushes(observation, model, PUSH_M, value)


def test_every_direction_has_its_push_of_a_lone_goal():
    found = evaluate(look((100, 100), task=PickGoal))
    assert [push.candidate.rotation for push in found] == list(range(16))
    for push in found:
        assert push.moves
        assert (push.wanted, push.gain, push.uncovered, push.loss) == (1, 0.0, 0.0, 0.0)


def test_a_push_out_of_a_row_frees_the_goal_and_one_along_it_does_not():
    gains = {
        push.candidate.rotation: push.gain
        for push in evaluate(look((100, 100), (100, 126), task=PickGoal))
        if push.candidate.cell[1] < 125
    }
    assert gains[4] > USEFUL_GAIN
    assert gains.get(0, 0.0) < USEFUL_GAIN


def test_without_a_goal_a_push_is_for_the_object_that_it_passes_through():
    observation = look((60, 60), (140, 140))
    found = evaluate(observation)
    assert {push.wanted for push in found} <= {1, 2}
    assert all(push.wanted == observation.labels[push.candidate.cell] for push in found)


def test_what_hides_a_goal_is_to_be_uncovered():
    found = evaluate(look((100, 100), task=Uncover))
    assert len(found) > 16  # side by side: the goal need not lie in the middle
    assert max(push.uncovered for push in found) > 0.9
    assert {(push.wanted, push.gain) for push in found} == {(None, 0.0)}


def test_to_lose_what_is_wanted_costs_more_than_to_lose_another():
    (wanted,) = (p for p in evaluate(look((100, 190), task=PickGoal)) if p.candidate.rotation == 0)
    (other,) = (p for p in evaluate(look((100, 120), (100, 165), task=PickGoal)) if p.candidate.rotation == 0)
    (safe,) = (p for p in evaluate(look((100, 100), task=PickGoal)) if p.candidate.rotation == 0)
    assert wanted.loss > other.loss > safe.loss == 0.0


def test_a_push_that_failed_is_not_proposed_again():
    observation = look((100, 100), task=PickGoal)
    line = evaluate(observation)[3].candidate.line
    start = CONFIG.workspace.position(line.row, line.col)
    failed = push_in_workspace(start, 3, PUSH_M, line.top_m, 0.0, CONFIG.workspace)
    again = evaluate(look((100, 100), task=PickGoal, barred=(failed,)))
    assert 3 not in {push.candidate.rotation for push in again}


def test_q_chooses_among_pushes_in_the_same_direction():
    def better_rows(cells):
        q = np.zeros(cells.shape, np.float32)
        q[:, 106:109] = 0.9
        return q

    (push,) = (p for p in evaluate(look((100, 100), task=PickGoal), better_rows) if p.candidate.rotation == 0)
    assert 106 <= push.candidate.cell[0] < 109
    assert push.candidate.q == pytest.approx(0.9)


def test_an_object_without_a_place_to_start_has_no_push():
    heights, labels = np.full((224, 224), 0.05, np.float32), np.ones((224, 224), np.int32)
    assert evaluate(Observation(heightmap(heights), labels, PickAny())) == []
