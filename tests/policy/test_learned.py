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
    network.grasp[2, 112, 140] = 0.95
    network.grasp[5, 110, 115] = 0.90
    action = decide(network, observation)
    assert (action.primitive, action.rotation, action.row, action.col) == (Primitive.GRASP, 5, 110, 115)
    assert action.q_value == pytest.approx(0.90)
    assert action.xyz == pytest.approx((*CONFIG.workspace.position(110, 115), 0.05))


def test_without_a_goal_the_best_object_is_taken(network, observation):
    network.grasp[2, 112, 140] = 0.95
    network.grasp[5, 110, 115] = 0.90
    network.grasp[7, 10, 10] = 2.0  # the bare table
    action = decide(network, replace(observation, goal=None))
    assert (action.rotation, action.row, action.col) == (2, 112, 140)


def test_a_doubtful_grasp_waits_for_a_push(network, observation):
    network.grasp[5, 110, 115] = 0.2
    network.push[0, 112, 112] = 0.8
    action = decide(network, observation)
    assert (action.primitive, action.rotation) == (Primitive.PUSH, 0)
    # The fingers come down behind the block that the cell is on.
    assert action.row == 112
    assert action.col < 100
    assert action.xyz[2] == pytest.approx(0.05)
    assert decide(network, replace(observation, may_push=False)).primitive is Primitive.GRASP
    assert decide(network, observation, may_push=False).primitive is Primitive.GRASP


def test_a_likely_grasp_is_not_delayed(network, observation):
    network.grasp[5, 110, 115] = 0.8
    network.push[0, 112, 112] = 1.0
    assert decide(network, observation).primitive is Primitive.GRASP


def test_a_failed_action_is_not_repeated(network, observation):
    network.grasp[5, 110, 115] = 0.9
    network.grasp[5, 112, 117] = 0.8  # 5 mm further on
    network.grasp[0, 120, 105] = 0.7
    first = decide(network, observation)
    second = decide(network, replace(observation, barred=(first,)))
    assert (second.rotation, second.row, second.col) == (0, 120, 105)


def test_a_failed_push_is_not_repeated(network, observation):
    network.grasp[5, 110, 115] = 0.1
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
    network.grasp[5, 110, 115] = 0.9
    network.grasp[0, 120, 105] = 0.85
    network.push[0, 112, 112] = 0.7
    first = decide(network, observation)
    assert first.primitive is Primitive.GRASP
    assert decide(network, replace(observation, barred=(first,))).primitive is Primitive.PUSH
