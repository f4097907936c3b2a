"""What one grasp costs in the twin, whole and by its parts, with 10 and with 30 objects on the table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

from policy import make_policy
from robotcell.cell import Cell, open_cell
from robotcell.config import load_config
from robotcell.jobs.policy_api import Observation, PickAny
from robotcell.motion.actions import Action, plan_action
from robotcell.motion.grasp import Grasp
from robotcell.motion.path_check import CheckedPlan, check_path

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pytest_benchmark.fixture import BenchmarkFixture

    from robotcell.jobs.policy_api import Policy
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
        plan = plan_action(action, view.heightmap, self.cell.arm.state().q, self.cell.config)
        return check_path(plan, self.cell.config)

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
