"""What one look and one decision cost, from a frame of the twin's camera to an action, whole and in parts:
`pytest tests/benchmarks/test_sight.py --benchmark-enable`.

Targets on two cores: heightmap 20 ms at 640x480 and 45 ms at 1280x720; decision 40 ms.
"""

import numpy as np
import pytest

from policy import make_policy
from policy.shadows import complete_heights
from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.goals import find_goal
from robotcell.perception.heightmap import build_heightmap
from robotcell.perception.segmentation import segment

OBJECTS = 30
RESOLUTIONS = pytest.mark.parametrize("resolution", ["640x480", "1280x720"], scope="module")


@pytest.fixture(scope="module")
def look(resolution):
    config = load_config(
        None,
        {
            "backend.options.seed": 5,
            "backend.options.objects": OBJECTS,
            "camera.resolution": resolution,
        },
    )
    with open_cell(config) as cell:
        frame = cell.camera.read()
    return config, frame


def heightmap_of(look):
    config, frame = look
    return build_heightmap(frame, CalibratedCamera.of(config.camera), config.workspace, config.table.height_m)


def observe(heightmap, *, goal):
    segmentation = segment(heightmap)
    largest = segmentation.instances[0]
    task = PickGoal(segmentation.mask(find_goal(segmentation, largest.color_name))) if goal else PickAny()
    return Observation(heightmap, segmentation.labels, task)


@RESOLUTIONS
def test_heightmap(benchmark, look):
    assert benchmark(heightmap_of, look).coverage > 0.7


@RESOLUTIONS
def test_segment(benchmark, look):
    heightmap = heightmap_of(look)
    assert len(benchmark(segment, heightmap).instances) > OBJECTS / 2


@RESOLUTIONS
def test_complete_heights(benchmark, look):
    config, _ = look
    heights = benchmark(complete_heights, heightmap_of(look), config.camera.pose()[:3, 3], config.table.height_m)
    assert np.isfinite(heights.height_m).all()


@RESOLUTIONS
@pytest.mark.parametrize("goal", [False, True], ids=["any", "goal"])
def test_decide(benchmark, look, goal):
    observation = observe(heightmap_of(look), goal=goal)
    assert 0 < benchmark(make_policy("heuristic", look[0]).decide, observation).q_value <= 1


@RESOLUTIONS
def test_loop(benchmark, look):
    """Frame, heightmap, masks, decision."""
    policy = make_policy("heuristic", look[0])
    assert benchmark(lambda: policy.decide(observe(heightmap_of(look), goal=True))).q_value > 0
