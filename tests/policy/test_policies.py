"""The policies that go by name."""

import subprocess
import sys

import numpy as np
import pytest

from policy import make_policy
from robotcell.config import Workspace, load_config
from robotcell.errors import ConfigError
from robotcell.jobs.policy_api import Observation, PickAny
from robotcell.motion.grasp import Grasp
from tests.robotcell.maps import heightmap

CONFIG = load_config()

# Makes the policies of its arguments, lets them decide, and says which of the heavy packages that loaded.
_LOADED = """
import sys
import numpy as np
from policy import make_policy
from robotcell.config import load_config
from robotcell.jobs.policy_api import Observation, PickAny
from robotcell.perception.heightmap import Heightmap
config = load_config()
heights = np.zeros(config.workspace.shape, np.float32)
heights[100:125, 100:125] = 0.05
labels = (heights > 0).astype(np.int32)
color = np.full((*heights.shape, 3), 90, np.uint8)
for name in sys.argv[1:]:
    seen = Heightmap(config.workspace, color, heights, None, 1.0, {}, 0.0)
    make_policy(name, config).decide(Observation(seen, labels, PickAny()))
print(*(name for name in ("torch", "torch._dynamo", "torch._inductor", "sympy") if name in sys.modules))
"""


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


@pytest.mark.parametrize("name", ["learned", "grasp-only", "single-stage", "heuristic"])
@pytest.mark.parametrize("resolution_m", [0.001, 0.005])
def test_a_policy_decides_on_the_map_that_it_declares_whatever_the_cell_says(name, resolution_m):
    cell = Workspace(x=(-0.65, -0.35), y=(-0.1, 0.1), resolution_m=resolution_m)
    policy = make_policy(name, CONFIG.model_copy(update={"workspace": cell}))
    workspace = policy.workspace
    assert (workspace.x, workspace.y, workspace.resolution_m) == (cell.x, cell.y, 0.002)
    heights = np.zeros(workspace.shape, np.float32)
    heights[40:65, 60:85] = 0.05
    labels = (heights > 0).astype(np.int32)
    action = policy.decide(Observation(heightmap(heights, workspace), labels, PickAny(), may_push=False))
    assert labels[workspace.cell(action.x, action.y)]
    shown = heightmap(np.zeros(cell.shape, np.float32), cell)
    with pytest.raises(ConfigError, match=f"{name!r} works on cells of 2 mm and is shown a map of"):
        policy.decide(Observation(shown, np.ones(cell.shape, np.int32), PickAny()))


def test_the_random_policy_works_at_any_resolution():
    workspace = Workspace(resolution_m=0.007)
    policy = make_policy("random", CONFIG.model_copy(update={"workspace": workspace}))
    assert policy.workspace == workspace


def test_an_unknown_policy_lists_those_that_exist():
    with pytest.raises(
        ConfigError, match="no policy is called 'best'; there is: grasp-only, heuristic, learned, random"
    ):
        make_policy("best", CONFIG)


def test_a_policy_without_a_network_needs_no_torch():
    told = subprocess.run(
        [sys.executable, "-c", _LOADED, "heuristic", "random"], capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == []


def test_deciding_loads_no_compiler_of_torch():
    told = subprocess.run([sys.executable, "-c", _LOADED, "learned"], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["torch"]
