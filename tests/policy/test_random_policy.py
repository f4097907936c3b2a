import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy import make_policy
from robotcell.config import CellConfig, Table, Workspace
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal, Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push
from tests.robotcell.maps import heightmap

CONFIG = CellConfig()
TABLE_M = CONFIG.table.height_m


def look(*boxes, goal=None, barred=(), may_push=True, workspace=None):
    """Boxes (row, col, side, height) in cells and metres; `goal` is the number of one of them."""
    workspace = workspace or Workspace()
    heights = np.zeros(workspace.shape, np.float32)
    labels = np.zeros(workspace.shape, np.int32)
    for number, (row, col, side, height_m) in enumerate(boxes, start=1):
        heights[row : row + side, col : col + side] = height_m
        labels[row : row + side, col : col + side] = number
    task = PickAny() if goal is None else PickGoal(labels == goal)
    return Observation(heightmap(heights, workspace), labels, task, barred, may_push)


def place(action):
    """(x, y) of the middle between the fingers, or of the start of a push."""
    return (action.x, action.y) if isinstance(action, Grasp) else action.start


def same(one, other):
    period = 8 if isinstance(one, Grasp) else 16
    turn = (one.rotation - other.rotation) % period
    near = math.dist(place(one), place(other)) < 0.02
    return type(one) is type(other) and near and min(turn, period - turn) <= 1


PAIR = ((40, 60, 25, 0.05), (120, 150, 20, 0.03))


def test_draws_are_spread_over_primitives_cells_and_rotations():
    policy, scene = make_policy("random", CONFIG), look(*PAIR)
    actions = [policy.decide(scene) for _ in range(600)]
    kinds = Counter(type(action) for action in actions)
    assert min(kinds.values()) > 250
    for kind, rotations in ((Grasp, 8), (Push, 16)):
        turns = Counter(action.rotation for action in actions if isinstance(action, kind))
        assert sorted(turns) == list(range(rotations))
        assert max(turns.values()) < 3 * kinds[kind] / rotations
    on_first = [scene.labels[Workspace().cell(a.x, a.y)] == 1 for a in actions if isinstance(a, Grasp)]
    assert np.mean(on_first) == pytest.approx(625 / 1025, abs=0.08)  # by area
    assert {action.q_value for action in actions} == {0.0}


def test_what_may_not_be_grasped_is_pushed():
    policy, scene = make_policy("random", CONFIG), look(*PAIR)
    scene = replace(scene, task=Uncover(scene.labels == 1))
    assert {type(policy.decide(scene)) for _ in range(20)} == {Push}


@settings(max_examples=30)
@given(
    goal=st.sampled_from([None, 1, 2]), may_push=st.booleans(), table_m=st.floats(-0.1, 0.1), draws=st.integers(1, 5)
)
def test_an_action_is_where_it_says_and_where_it_may_be(goal, may_push, table_m, draws):
    scene = look(*PAIR, goal=goal, may_push=may_push)
    policy = make_policy("random", CellConfig(table=Table(height_m=table_m)))
    targets = scene.targets()
    tops = {1: 0.05, 2: 0.03}
    for _ in range(draws):
        action = policy.decide(scene)
        row, col = Workspace().cell(*place(action))
        assert Workspace().position(row, col) == pytest.approx(place(action))
        assert may_push or isinstance(action, Grasp)
        if isinstance(action, Grasp):
            assert targets[row, col]
            assert action.surface_m == pytest.approx(tops[scene.labels[row, col]], abs=1e-6)
        else:
            assert not scene.objects[row, col]
            rows, cols = np.nonzero(targets)
            nearest = np.maximum(abs(rows - row), abs(cols - col)).argmin()
            assert max(abs(rows[nearest] - row), abs(cols[nearest] - col)) <= 15
            assert action.top_m == pytest.approx(tops[scene.labels[rows[nearest], cols[nearest]]], abs=1e-6)


def test_the_reach_of_pushes_is_in_metres():
    workspace = Workspace(resolution_m=0.005)
    policy = make_policy("random", CellConfig(workspace=workspace))
    scene = look((40, 40, 10, 0.05), workspace=workspace)
    pushes = [a for a in (policy.decide(scene) for _ in range(300)) if isinstance(a, Push)]
    cells = [workspace.cell(*push.start) for push in pushes]
    reach = max(max(40 - row, row - 49, 40 - col, col - 49) for row, col in cells)
    assert reach == 6


def test_the_same_seed_gives_the_same_actions_and_each_decision_another():
    scene = look(*PAIR)
    first, second = make_policy("random", CONFIG), make_policy("random", CONFIG)
    actions = [first.decide(scene) for _ in range(10)]
    assert actions == [second.decide(scene) for _ in range(10)]
    assert len(set(actions)) == 10


@pytest.mark.parametrize("may_push", [False, True])
def test_what_failed_is_not_repeated_until_nothing_is_left(may_push):
    workspace = Workspace(x=(-0.54, -0.46), y=(-0.04, 0.04), resolution_m=0.01)
    policy, barred = make_policy("random", CellConfig(workspace=workspace)), ()

    message = "every grasp and every push has failed" if may_push else "every grasp has failed"
    with pytest.raises(NoTarget, match=message):  # noqa: PT012
        while True:
            scene = look((3, 3, 2, 0.05), barred=barred, may_push=may_push, workspace=workspace)
            action = policy.decide(scene)
            assert not any(same(action, failed) for failed in barred)
            barred = (*barred, action)
    assert len(barred) > 20 if may_push else len(barred) in {3, 4}


def test_an_object_that_fills_the_map_can_only_be_grasped():
    policy = make_policy("random", CONFIG)
    full = look((0, 0, 224, 0.05))
    assert {type(policy.decide(full)) for _ in range(20)} == {Grasp}


def test_nothing_to_act_on():
    policy = make_policy("random", CONFIG)
    with pytest.raises(NoTarget, match="no object is seen"):
        policy.decide(look())
    with pytest.raises(NoTarget, match="no cell of the goal is seen"):
        policy.decide(look(*PAIR, goal=3))


def test_it_is_called_random():
    assert make_policy("random", CONFIG).name == "random"
