"""What one grasp costs in the twin, whole and by its parts, with 10 and with 30 objects on the table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from policy import make_policy
from robotcell.cell import Cell, open_cell
from robotcell.config import load_config
from robotcell.config.surroundings import bin_box
from robotcell.geometry.transforms import make_transform
from robotcell.jobs.policy_api import Observation, PickAny
from robotcell.motion.grasp import Grasp
from robotcell.motion.way import plan_way
from robotcell.perception.clearance_map import build_clearance_map
from sim_twin.devices.backend import open_twin
from sim_twin.scenes.meshes import hull
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import block, shape_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pytest_benchmark.fixture import BenchmarkFixture

    from robotcell.geometry.transforms import Array
    from robotcell.jobs.policy_api import Policy
    from robotcell.motion.actions import Action
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.view import View

ROUNDS = 7


@dataclass
class Bench:
    """A cell, its policy, and the steps of one turn of a job."""

    cell: Cell
    policy: Policy

    def look(self) -> View:
        return self.cell.look(self.policy.workspace)

    def decide(self, view: View) -> Action:
        """The best grasp; pushes would make the rounds unlike each other."""
        action = self.policy.decide(Observation(view.heightmap, view.segmentation.labels, PickAny(), may_push=False))
        assert isinstance(action, Grasp)
        return action

    def plan(self, view: View, action: Action) -> CheckedPlan:
        return plan_way(action, view.heightmap, view.clearance, self.cell.arm.state().q, self.cell.config)

    def run(self, checked: CheckedPlan) -> None:
        self.cell.executor.run(checked)

    def whole(self) -> None:
        view = self.look()
        self.run(self.plan(view, self.decide(view)))


@pytest.fixture(params=[10, 30], ids=["10 objects", "30 objects"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    config = load_config(None, {"backend.options.objects": request.param, "backend.options.seed": 1})
    with open_cell(config) as cell:
        yield Bench(cell, make_policy("heuristic", config))


def test_whole_grasp(benchmark: BenchmarkFixture, bench: Bench) -> None:
    """Look, decide, plan, check, grasp, carry to the bin, home: one object fewer each round."""
    benchmark.pedantic(bench.whole, rounds=ROUNDS)


def test_look(benchmark: BenchmarkFixture, bench: Bench) -> None:
    """Camera, heightmap and segmentation."""
    benchmark.pedantic(bench.look, rounds=ROUNDS)


def test_decide(benchmark: BenchmarkFixture, bench: Bench) -> None:
    benchmark.pedantic(bench.decide, args=(bench.look(),), rounds=ROUNDS)


def test_plan_and_check(benchmark: BenchmarkFixture, bench: Bench) -> None:
    view = bench.look()
    benchmark.pedantic(bench.plan, args=(view, bench.decide(view)), rounds=ROUNDS)


def test_run(benchmark: BenchmarkFixture, bench: Bench) -> None:
    """Motion and physics: one object fewer each round."""

    def setup() -> tuple[tuple[Any, ...], dict[str, Any]]:
        view = bench.look()
        return (bench.plan(view, bench.decide(view)),), {}

    benchmark.pedantic(bench.run, setup=setup, rounds=ROUNDS)


def test_map_of_clearance(benchmark: BenchmarkFixture, bench: Bench) -> None:
    """What the path check asks, once per frame: part of the look, and of the first plan by it."""
    view, config = bench.look(), bench.cell.config

    def build() -> float:
        seen = build_clearance_map(view.frame, view.camera, config.table.height_m, (bin_box(config),))
        return float(seen.gaps(np.array([[-0.5, 0.0, 0.05]]), np.array([0.05]), 0.0, 0.1)[0])

    benchmark.pedantic(build, rounds=ROUNDS)


def test_plan_among_posts(benchmark: BenchmarkFixture) -> None:
    """A way over a post of 0.25 m beside the goal: what a detour costs."""
    config = load_config(None, {"backend.options.objects": 1})
    corners = np.array([(a, b, c) for a in (-0.03, 0.03) for b in (-0.03, 0.03) for c in (-0.125, 0.125)])
    post = SceneObject("post", shape_of("post", (hull(corners),)), (78, 121, 167), _at(-0.5, 0.10, 0.125))
    cube = SceneObject("cube", block("cube"), (255, 60, 60), _at(-0.5, 0.0, 0.025))
    with open_twin(config, Scene("post", (cube, post), drop=False))[0] as cell:
        view, q = cell.look(), cell.arm.state().q
        grasp = Grasp(-0.5, 0.0, 0.05, 5, 1.0)
        benchmark.pedantic(plan_way, args=(grasp, view.heightmap, view.clearance, q, config), rounds=ROUNDS)


def _at(x: float, y: float, z: float) -> Array:
    return make_transform(np.eye(3), (x, y, z))
