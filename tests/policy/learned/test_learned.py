"""What the learned policy makes of Q maps."""

from dataclasses import replace

import numpy as np
import pytest

from policy.learned.policy import LearnedPolicy
from robotcell.config import load_config
from robotcell.errors import ConfigError, NoTarget
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal, Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push
from tests.robotcell.maps import heightmap

CONFIG = load_config()
GOAL, OTHER = (slice(100, 125), slice(100, 125)), (slice(100, 125), slice(126, 151))


class Maps:
    """A network that answers with given maps where it is asked."""

    def __init__(self):
        self.grasp = np.zeros((8, 224, 224), np.float32)
        # No map of a network is flat.
        self.push = np.tile(np.linspace(0, 0.01, 224, dtype=np.float32), (16, 224, 1))
        for place in (GOAL, OTHER):
            self.grasp[0][place][0, 0] = 0.01

    def maps(self, planes, cells, primitive):
        assert planes.shape == (5, 224, 224)
        return np.where(cells, (self.grasp, self.push)[primitive], np.float32(np.nan))


def put(maps, rotation, row, col, value):
    """A peak as a network has them: some cells wide, highest in the middle."""
    rows, cols = np.mgrid[:224, :224]
    peak = value * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / (2 * 6.0**2))
    maps[rotation] = np.maximum(maps[rotation], peak)


@pytest.fixture
def network():
    return Maps()


@pytest.fixture
def observation():
    heights = np.zeros((224, 224), np.float32)
    labels = np.zeros((224, 224), np.int32)
    for label, place in enumerate((GOAL, OTHER), start=1):
        heights[place] = 0.05
        labels[place] = label
    return Observation(heightmap(heights), labels, PickGoal(labels == 1))


@pytest.fixture
def alone(observation):
    heights, labels = np.zeros((224, 224), np.float32), np.zeros((224, 224), np.int32)
    heights[GOAL], labels[GOAL] = 0.05, 1
    return Observation(heightmap(heights), labels, PickGoal(labels == 1))


def decide(network, observation, **options):
    return LearnedPolicy(CONFIG, network, "learned", **options).decide(observation)


def test_the_goal_selects_from_the_maps(network, observation):
    put(network.grasp, 4, 112, 138, 0.95)
    put(network.grasp, 5, 112, 113, 0.90)
    action = decide(network, observation)
    assert isinstance(action, Grasp)
    assert (action.rotation, CONFIG.workspace.cell(action.x, action.y)) == (5, (112, 113))
    assert action.q_value == pytest.approx(0.90, abs=0.06)
    assert (action.x, action.y) == pytest.approx(CONFIG.workspace.position(112, 113))
    assert action.surface_m == pytest.approx(0.05)


def test_without_a_goal_the_best_object_is_taken(network, observation):
    put(network.grasp, 4, 112, 138, 0.95)
    put(network.grasp, 5, 112, 113, 0.90)
    put(network.grasp, 7, 10, 10, 2.0)  # the bare table
    action = decide(network, replace(observation, task=PickAny()))
    assert (action.rotation, CONFIG.workspace.cell(action.x, action.y)) == (4, (112, 138))


def test_a_doubtful_grasp_waits_for_a_push(network, observation):
    put(network.grasp, 5, 110, 115, 0.2)
    network.push[0, 105:120, 105:120] = 0.8
    action = decide(network, observation)
    assert isinstance(action, Push)
    assert action.top_m == pytest.approx(0.05)
    assert isinstance(decide(network, replace(observation, may_push=False)), Grasp)
    assert isinstance(decide(network, observation, may_push=False), Grasp)


def test_what_a_push_frees_counts_more_than_its_q(network, observation):
    put(network.grasp, 5, 110, 115, 0.2)
    network.push[0, 105:120, 105:120] = 0.5  # takes the neighbour along
    network.push[8, 130:145, 130:145] = 0.5  # pushes it against the goal
    action = decide(network, observation)
    assert action.rotation not in {0, 8}


def test_among_pushes_that_free_alike_the_q_decides(network, alone):
    put(network.grasp, 5, 110, 115, 0.2)
    for k, value in ((0, 0.8), (4, 0.9)):
        network.push[k, 105:120, 105:120] = value
    action = decide(network, alone)
    assert isinstance(action, Push)
    assert (action.rotation, action.q_value) == (4, pytest.approx(0.9))
    # The fingers come down behind the block that the cell is on.
    row, col = CONFIG.workspace.cell(*action.start)
    assert row < 100
    assert 105 <= col < 120


def test_what_would_be_lost_is_not_pushed(network, observation):
    # At the edge of the map, with no neighbour.
    heights, labels = np.zeros((224, 224), np.float32), np.zeros((224, 224), np.int32)
    heights[100:125, 190:215], labels[100:125, 190:215] = 0.05, 1
    edge = Observation(heightmap(heights), labels, PickGoal(labels == 1))
    network.grasp[0, 110, 200] = network.push[0, 110, 200] = 0.01
    network.push[0, 105:120, 195:210] = 0.9
    network.push[8, 105:120, 195:210] = 0.3
    network.push[4, 105:120, 195:210] = 0.5
    assert decide(network, edge).rotation == 4


def test_what_may_not_be_grasped_is_pushed(network, observation):
    put(network.grasp, 5, 110, 115, 0.95)
    network.push[0, 112, 112] = 0.1
    hidden = replace(observation, task=Uncover(observation.labels == 1))
    assert isinstance(decide(network, hidden), Push)
    with pytest.raises(NoTarget):
        decide(network, hidden, may_push=False)


def test_where_no_push_begins_near_the_goal_one_farther_out_is_taken(network):
    heights, labels = np.zeros((224, 224), np.float32), np.zeros((224, 224), np.int32)
    heights[35:190, 35:190], labels[35:190, 35:190] = 0.05, 2
    labels[GOAL] = 1
    heap = Observation(heightmap(heights), labels, PickGoal(labels == 1))
    put(network.grasp, 5, 110, 115, 0.02)
    network.push[0, 108:116, 55:63] = 0.9
    action = decide(network, heap)
    assert isinstance(action, Push)
    assert not heights[CONFIG.workspace.cell(*action.start)]


def test_a_likely_grasp_is_not_delayed(network, observation):
    put(network.grasp, 5, 110, 115, 0.9)
    network.push[0, 112, 112] = 1.0
    assert isinstance(decide(network, observation), Grasp)


def test_a_failed_action_is_not_repeated(network, observation):
    put(network.grasp, 5, 110, 115, 0.9)
    put(network.grasp, 5, 112, 117, 0.8)  # 5 mm further on
    put(network.grasp, 3, 112, 110, 0.7)
    first = decide(network, observation)
    second = decide(network, replace(observation, barred=(first,), may_push=False))
    assert (first.rotation, second.rotation) == (5, 3)


def test_fingers_that_would_land_on_a_neighbour_are_no_grasp(network, observation):
    put(network.grasp, 0, 112, 112, 1.0)  # the right finger comes down on the other block
    put(network.grasp, 4, 112, 112, 0.7)
    action = decide(network, replace(observation, may_push=False))
    assert (action.rotation, action.q_value) == (4, pytest.approx(0.7, abs=0.05))


def test_a_lone_peak_is_no_grasp(network, observation):
    network.grasp[4, 112, 105] = 1.0
    put(network.grasp, 4, 112, 118, 0.7)
    action = decide(network, replace(observation, may_push=False))
    assert CONFIG.workspace.cell(action.x, action.y)[1] == pytest.approx(118, abs=1)


def test_a_failed_push_is_not_repeated(network, alone):
    put(network.grasp, 5, 110, 115, 0.1)
    network.push[0, 111:114, 111:114] = 0.9
    network.push[4, 111:114, 111:114] = 0.8
    first = decide(network, alone)
    second = decide(network, replace(alone, barred=(first,)))
    assert (first.rotation, second.rotation) == (0, 4)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_broken_maps_are_an_error(network, observation, value):
    network.grasp[:] = value
    network.push[0, 0, 0] = 1.0
    with pytest.raises(ConfigError, match="grasp maps"):
        decide(network, observation)


def test_an_empty_table_is_no_target(network, observation):
    with pytest.raises(NoTarget, match="no object"):
        decide(network, replace(observation, labels=np.zeros_like(observation.labels), task=PickAny()))


def test_grasps_that_failed_make_room_for_a_push(network, observation):
    put(network.grasp, 5, 110, 115, 0.9)
    put(network.grasp, 0, 120, 105, 0.85)
    network.push[0, 112, 112] = 0.7
    first = decide(network, observation)
    assert isinstance(first, Grasp)
    assert isinstance(decide(network, replace(observation, barred=(first,))), Push)
