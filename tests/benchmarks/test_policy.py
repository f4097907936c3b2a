"""From a frame to an action with the learned policy, whole and in parts, and the paper's network beside it:
`pytest tests/benchmarks/test_policy.py --benchmark-enable -s`.

Targets on two cores at 640x480: frame to action 60 ms, and the paper's network at least 50 times slower.
"""

import statistics
import sys
import time
from collections import defaultdict

import numpy as np
import pytest
import torch

from policy import make_policy
from policy.finger_clearance import OpenGripper
from policy.learned.graspability import Graspability
from policy.network.encoding import GRASP, PUSH, encode
from policy.network.inference import Inference
from policy.network.registry import make_network
from policy.network.weights import load_named
from policy.push.candidates import cells_with_start, pushable_cells
from policy.push.line import free_to_descend, push_line
from policy.push.outcome import PushForwardModel
from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Observation, PickGoal
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.goals import find_goal
from robotcell.perception.heightmap import build_heightmap, close_gaps
from robotcell.perception.segmentation import segment

OBJECTS = 30
ROUNDS = 20
SCENES = 20


@pytest.fixture(scope="module")
def config():
    return load_config(None, {"backend.options.seed": 5, "backend.options.objects": OBJECTS})


@pytest.fixture(scope="module")
def frame(config):
    with open_cell(config) as cell:
        return cell.camera.read()


@pytest.fixture(scope="module")
def heightmap(config, frame):
    return build_heightmap(frame, CalibratedCamera.of(config.camera), config.workspace, config.table.height_m)


@pytest.fixture(scope="module")
def policy(config):
    return make_policy("learned", config)


@pytest.fixture(scope="module")
def inference():
    return Inference(load_named("learned")[0])


def observe(heightmap, *, may_push=True):
    segmentation = segment(heightmap)
    goal = find_goal(segmentation, segmentation.instances[0].color_name)
    return Observation(heightmap, segmentation.labels, PickGoal(segmentation.mask(goal)), may_push=may_push)


def frame_to_action(config, frame, policy, *, may_push=True):
    heightmap = build_heightmap(frame, CalibratedCamera.of(config.camera), config.workspace, config.table.height_m)
    return policy.decide(observe(heightmap, may_push=may_push))


def test_encode(benchmark, heightmap):
    assert benchmark(encode, close_gaps(heightmap.height_m), heightmap.color).shape == (5, 224, 224)


def test_grasp_maps(benchmark, heightmap, inference):
    planes, goal = encode(heightmap.closed_m, heightmap.color), observe(heightmap).targets()
    assert np.isfinite(benchmark(inference.maps, planes, goal, GRASP)[:, goal]).all()


def test_push_maps(benchmark, config, heightmap, inference):
    """Near the middle of the goal, as the policy asks for them."""
    planes, observation = encode(heightmap.closed_m, heightmap.color), observe(heightmap)
    free = free_to_descend(heightmap.closed_m, config.workspace)
    mask = pushable_cells(observation.targets(), observation.objects, config.workspace.resolution_m)
    middle = np.broadcast_to(np.argwhere(observation.targets()).mean(axis=0), (*mask.shape, 2))
    possible = cells_with_start(mask, middle, free, config.motion.push_m, config.workspace.resolution_m, 0.016)
    assert np.isfinite(benchmark(inference.maps, planes, possible, PUSH)[possible]).all()


def test_predict(benchmark, config, heightmap, inference):
    """One push, and what it promises for the goal."""
    observation = observe(heightmap)
    goal, height_m = int(observation.labels[observation.targets()].max()), heightmap.closed_m
    resolution_m = config.workspace.resolution_m
    free = free_to_descend(height_m, config.workspace)
    cells = np.argwhere(pushable_cells(observation.targets(), observation.objects, resolution_m)).tolist()
    lines = (push_line(height_m, free, cell, 0, config.motion.push_m, resolution_m) for cell in cells)
    line = next(line for line in lines if line is not None)
    model = PushForwardModel(observation.labels, heightmap)
    gripper = OpenGripper.of(config)
    graspability = Graspability(inference, model, observation.labels, heightmap, gripper)

    def predict():
        around_m = model.height_around(goal, model.predict(line, 0))
        return model.border_gain(goal, around_m), graspability.after(goal, around_m)

    assert np.isfinite(benchmark(predict)).all()


# The goal of this frame needs a push; where none is allowed, the decision costs what a clear grasp costs.
decisions = pytest.mark.parametrize(("may_push", "kind"), [(False, Grasp), (True, Push)], ids=["grasp", "push"])


@decisions
def test_decide(benchmark, heightmap, policy, may_push, kind):
    observation = observe(heightmap, may_push=may_push)
    assert isinstance(benchmark(policy.decide, observation), kind)


@decisions
def test_frame_to_action(benchmark, config, frame, policy, may_push, kind):
    assert isinstance(benchmark(frame_to_action, config, frame, policy, may_push=may_push), kind)


def test_frames_to_actions(benchmark):
    """First decisions among 30 objects, whatever they are; as in the suite `random`, where the goal is seen."""
    times = defaultdict(list)
    # Where nothing is measured, one scene shows that the benchmark runs.
    seeds = range(SCENES) if benchmark.enabled else (1,)

    def decide_all():
        for seed in seeds:
            scene = {"seed": seed, "scene": "random-goal", "objects": OBJECTS}
            config = load_config(None, {f"backend.options.{name}": value for name, value in scene.items()})
            with open_cell(config) as cell:
                frame = cell.camera.read()
            policy = make_policy("learned", config)
            for _ in range(ROUNDS // 4):
                started = time.perf_counter()
                heightmap = build_heightmap(
                    frame, CalibratedCamera.of(config.camera), config.workspace, config.table.height_m
                )
                segmentation = segment(heightmap)
                try:
                    goal = segmentation.mask(find_goal(segmentation, "red"))
                except NoTarget:
                    break
                action = policy.decide(Observation(heightmap, segmentation.labels, PickGoal(goal)))
                times[type(action).__name__.lower()].append(time.perf_counter() - started)

    benchmark.pedantic(decide_all, rounds=1)
    every = [seconds for found in times.values() for seconds in found]
    parts = [f"{kind} {1000 * statistics.median(found):.0f} ms ({len(found)})" for kind, found in times.items()]
    sys.stdout.write(f"\nframe to action, median: {', '.join(parts)}, all {1000 * statistics.median(every):.0f} ms\n")


def test_beside_the_paper_network(benchmark, config, frame, heightmap, policy):
    """The paper's network once, ours many times, in the same process and run."""
    paper = Inference(make_network("paper"))
    # Of so many cells, its sixteen copies are 320 x 320 cells, as in the paper.
    cells = np.zeros(heightmap.height_m.shape, np.bool_)
    margin = 40 if benchmark.enabled else 100
    cells[margin:-margin, margin:-margin] = True

    def compare():
        started = time.perf_counter()
        paper.maps(encode(close_gaps(heightmap.height_m), heightmap.color), cells, PUSH)
        paper_s = time.perf_counter() - started
        ours = []
        for _ in range(ROUNDS if benchmark.enabled else 1):
            started = time.perf_counter()
            frame_to_action(config, frame, policy)
            ours.append(time.perf_counter() - started)
        return paper_s, statistics.median(ours)

    paper_s, ours_s = benchmark.pedantic(compare, rounds=1)
    sys.stdout.write(
        f"\n{torch.get_num_threads()} threads: paper's network {paper_s:.1f} s, "
        f"frame to action {1000 * ours_s:.1f} ms, {paper_s / ours_s:.0f} times faster\n"
    )
