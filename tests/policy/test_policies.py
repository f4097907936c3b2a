"""The policies that go by name."""

import numpy as np
import pytest

from policy import make_policy
from robotcell.config import load_config
from robotcell.errors import ConfigError
from robotcell.jobs.policy_api import Observation, PickAny
from robotcell.motion.grasp import Grasp
from tests.robotcell.maps import heightmap

CONFIG = load_config()


@pytest.mark.parametrize("name", ["learned", "grasp-only", "single-stage", "heuristic", "random"])
def test_every_policy_comes_with_what_it_needs(name):
    heights = np.zeros(CONFIG.workspace.shape, np.float32)
    heights[100:125, 100:125] = 0.05
    labels = (heights > 0).astype(np.int32)
    policy = make_policy(name, CONFIG)
    action = policy.decide(Observation(heightmap(heights), labels, PickAny(), may_push=False))
    assert policy.name == name
    assert isinstance(action, Grasp)
    assert labels[policy.workspace.cell(action.x, action.y)]


def test_an_unknown_policy_lists_those_that_exist():
    with pytest.raises(
        ConfigError, match="no policy is called 'best'; there is: grasp-only, heuristic, learned, random"
    ):
        make_policy("best", CONFIG)
