"""What the learned policy makes of Q maps."""

from dataclasses import replace

import numpy as np
import pytest

from policy.learned import LearnedPolicy
from robotcell.config import load_config
from robotcell.decision import Observation, Primitive
from robotcell.errors import ConfigError, NoTarget
from tests.robotcell.maps import heightmap

CONFIG = load_config()
GOAL, OTHER = (slice(100, 125), slice(100, 125)), (slice(100, 125), slice(126, 151))


class Maps:
    """A network that answers with given maps where it is asked."""

    def __init__(self):
        self.grasp = np.zeros((8, 224, 224), np.float32)
        self.push = np.zeros((16, 224, 224), np.float32)
        # No map of a network is flat.
        for place in (GOAL, OTHER):
            self.grasp[0][place][0, 0] = self.push[0][place][0, 0] = 0.01

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
    return Observation(heightmap(heights), labels, labels == 1, (), may_push=True)


def decide(network, observation, **options):
    return LearnedPolicy(CONFIG, network, "learned", **options).decide(observation)


def test_the_goal_selects_from_the_maps(network, observation):
    put(network.grasp, 4, 112, 138, 0.95)
    put(network.grasp, 5, 112, 113, 0.90)
    action = decide(network, observation)
    assert (action.primitive, action.rotation, action.row, action.col) == (Primitive.GRASP, 5, 112, 113)
    assert action.q_value == pytest.approx(0.90, abs=0.06)
    assert action.xyz == pytest.approx((*CONFIG.workspace.position(112, 113), 0.05))


def test_without_a_goal_the_best_object_is_taken(network, observation):
    put(network.grasp, 4, 112, 138, 0.95)
    put(network.grasp, 5, 112, 113, 0.90)
    put(network.grasp, 7, 10, 10, 2.0)  # the bare table
    action = decide(network, replace(observation, goal=None))
    assert (action.rotation, action.row, action.col) == (4, 112, 138)


def test_a_doubtful_grasp_waits_for_a_push(network, observation):
    put(network.grasp, 5, 110, 115, 0.2)
    network.push[0, 112, 112] = 0.8
    action = decide(network, observation)
    assert (action.primitive, action.rotation) == (Primitive.PUSH, 0)
    # The fingers come down behind the block that the cell is on.
    assert action.row == 112
    assert action.col < 100
    assert action.xyz[2] == pytest.approx(0.05)
    assert decide(network, replace(observation, may_push=False)).primitive is Primitive.GRASP
    assert decide(network, observation, may_push=False).primitive is Primitive.GRASP


def test_what_may_not_be_grasped_is_pushed(network, observation):
    put(network.grasp, 5, 110, 115, 0.95)
    network.push[0, 112, 112] = 0.1
    assert decide(network, replace(observation, may_grasp=False)).primitive is Primitive.PUSH
    with pytest.raises(NoTarget):
        decide(network, replace(observation, may_grasp=False), may_push=False)


def test_a_likely_grasp_is_not_delayed(network, observation):
    put(network.grasp, 5, 110, 115, 0.9)
    network.push[0, 112, 112] = 1.0
    assert decide(network, observation).primitive is Primitive.GRASP


def test_a_failed_action_is_not_repeated(network, observation):
    put(network.grasp, 5, 110, 115, 0.9)
    put(network.grasp, 5, 112, 117, 0.8)  # 5 mm further on
    put(network.grasp, 3, 112, 110, 0.7)
    first = decide(network, observation)
    second = decide(network, replace(observation, barred=(first,)))
    assert (first.rotation, second.rotation) == (5, 3)


def test_fingers_that_would_land_on_a_neighbour_are_no_grasp(network, observation):
    put(network.grasp, 0, 112, 112, 1.0)  # the right finger comes down on the other block
    put(network.grasp, 4, 112, 112, 0.5)
    action = decide(network, replace(observation, may_push=False))
    assert (action.rotation, action.q_value) == (4, pytest.approx(0.5, abs=0.05))


def test_a_lone_peak_is_no_grasp(network, observation):
    network.grasp[4, 112, 105] = 1.0
    put(network.grasp, 4, 112, 118, 0.7)
    action = decide(network, replace(observation, may_push=False))
    assert action.col == pytest.approx(118, abs=1)


def test_a_failed_push_is_not_repeated(network, observation):
    put(network.grasp, 5, 110, 115, 0.1)
    network.push[0, 112, 112] = 0.9
    network.push[4, 112, 112] = 0.8
    first = decide(network, observation)
    second = decide(network, replace(observation, barred=(first,)))
    assert (first.rotation, second.rotation) == (0, 4)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_broken_maps_are_an_error(network, observation, value):
    network.grasp[:] = value
    network.push[0, 0, 0] = 1.0
    with pytest.raises(ConfigError, match="grasp maps"):
        decide(network, observation)


def test_an_empty_table_is_no_target(network, observation):
    with pytest.raises(NoTarget, match="no object"):
        decide(network, replace(observation, labels=np.zeros_like(observation.labels), goal=None))


def test_grasps_that_failed_make_room_for_a_push(network, observation):
    put(network.grasp, 5, 110, 115, 0.9)
    put(network.grasp, 0, 120, 105, 0.85)
    network.push[0, 112, 112] = 0.7
    first = decide(network, observation)
    assert first.primitive is Primitive.GRASP
    assert decide(network, replace(observation, barred=(first,))).primitive is Primitive.PUSH
