"""Jobs in the twin, judged against what the simulator knows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from policy import make_policy
from robotcell.cell import Cell, open_cell
from robotcell.config import CellConfig, load_config
from robotcell.decision import Action, Observation, Primitive
from robotcell.errors import CalibrationError, DeviceFault, GuardTripped, NoTarget
from robotcell.executor import Ending, Execution, Executor
from robotcell.jobs import Decision, Outcome, Report, Result, View, judge, look, run_job
from robotcell.journal import Journal
from robotcell.perception import find_goal
from robotcell.safety import Guard, check_plan

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SCENE = """
name = "two cubes"
drop = false

[[object]]
name = "goal"
shape = "cube"
color = "red"
position = [0.0, 0.06, 0.025]

[[object]]
name = "other"
shape = "cube"
color = "blue"
position = [0.0, -0.06, 0.025]
"""


@pytest.fixture
def config(tmp_path: Path) -> CellConfig:
    scene = tmp_path / "two-cubes.toml"
    scene.write_text(SCENE)
    return load_config(None, {"backend.options.scene": str(scene), "journal.runs": str(tmp_path / "runs")})


@dataclass
class Scripted:
    """A policy whose actions are functions of what it sees."""

    script: list[Callable[[Observation], Action]]
    name: str = "scripted"
    seen: list[Observation] = field(default_factory=list)

    def decide(self, observation: Observation) -> Action:
        self.seen.append(observation)
        if not self.script:
            raise NoTarget("the script is over")
        return self.script.pop(0)(observation)


def grasp_at(x: float, y: float, z: float = 0.05, rotation: int = 0) -> Callable[[Observation], Action]:
    def act(observation: Observation) -> Action:
        row, col = observation.heightmap.workspace.cell(x, y)
        return Action(Primitive.GRASP, row, col, rotation, (x, y, z), 1.0)

    return act


RED, BLUE = (-0.5, 0.06), (-0.5, -0.06)


def run(config: CellConfig, policy: Scripted, goals: tuple[str, ...] | None) -> tuple[Report, list[Result], Journal]:
    results: list[Result] = []

    class Collector:
        def started(self, job_id: int, run_dir: Path) -> None: ...

        def looked(self, view: View) -> None: ...

        def decided(self, decision: Decision) -> None: ...

        def ended(self, decision: Decision, outcome: Outcome) -> None:
            results.append(outcome.result)

    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        report = run_job(cell, policy, journal, goals, (Collector(),))
    return report, results, journal


def test_a_goal_is_picked_and_confirmed(config: CellConfig) -> None:
    report, results, _ = run(config, Scripted([grasp_at(*RED)]), ("red",))
    assert results == [Result.PICKED]
    assert report.completed
    assert report.metrics.picked == ("red",)
    assert sorted(path.name for path in (report.run_dir / "frames").iterdir())


def test_a_wrong_object_counts_as_wrong(config: CellConfig) -> None:
    report, results, _ = run(config, Scripted([grasp_at(*BLUE)]), ("red",))
    assert results == [Result.WRONG_OBJECT]
    assert not report.completed
    assert report.metrics.grasp_successes == 0
    assert report.metrics.picked == ("blue",)


def test_an_empty_grasp_is_missed_and_barred(config: CellConfig) -> None:
    policy = Scripted([grasp_at(-0.4, 0.0), grasp_at(*RED)])
    report, results, _ = run(config, policy, ("red",))
    assert results == [Result.MISSED, Result.PICKED]
    assert [len(observation.barred) for observation in policy.seen] == [0, 1]
    assert report.completed


def test_a_finger_on_an_object_ends_the_descent(config: CellConfig) -> None:
    # The finger comes down on the middle of the cube.
    x = RED[0] - config.gripper.preshape_m / 2
    report, results, _ = run(config, Scripted([grasp_at(x, RED[1])]), ("red",))
    assert results == [Result.COLLIDED]
    assert not report.completed


def test_an_unsafe_action_is_refused_and_nothing_moves(config: CellConfig) -> None:
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        q = cell.arm.state().q
        report = run_job(cell, Scripted([grasp_at(-1.4, 0.0)] * 1), journal, ("red",))
        np.testing.assert_allclose(cell.arm.state().q, q, atol=1e-3)
        (row,) = journal.job(report.job_id).actions
    assert row.outcome is not None
    assert row.outcome.result == "refused"
    assert "cannot reach" in row.outcome.detail


def test_ten_failures_in_a_row_end_the_run(config: CellConfig) -> None:
    report, results, _ = run(config, Scripted([grasp_at(-1.4, 0.0)] * 20), ("red",))
    assert results == [Result.REFUSED] * 10
    assert "10 failed attempts in a row" in report.reason


def test_five_pushes_in_a_row_are_the_most(config: CellConfig) -> None:
    def push(observation: Observation) -> Action:
        row, col = observation.heightmap.workspace.cell(-0.6, -0.15)
        return Action(Primitive.PUSH, row, col, 0, (-0.6, -0.15, 0.05), 1.0)

    policy = Scripted([push] * 5 + [grasp_at(*RED)])
    run(config, policy, ("red",))
    assert [observation.may_push for observation in policy.seen] == [True] * 5 + [False]


def test_a_goal_that_is_not_there_is_an_error_that_lists_what_is(config: CellConfig) -> None:
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        with pytest.raises(NoTarget, match=r"no green object.*blue, red"):
            run_job(cell, Scripted([]), journal, ("green",))
        assert journal.jobs()[0].status == "incomplete"


def test_everything_is_picked_in_any_order(config: CellConfig) -> None:
    policy = make_policy("heuristic", config)
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        report = run_job(cell, policy, journal, None)
    assert report.completed
    assert sorted(report.metrics.picked) == ["blue", "red"]


def test_goals_are_picked_in_their_order(config: CellConfig) -> None:
    policy = make_policy("heuristic", config)
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        report = run_job(cell, policy, journal, ("blue", "red"))
        goals = [row.goal for row in journal.job(report.job_id).actions]
    assert report.metrics.picked == ("blue", "red")
    assert goals == sorted(goals, key=str)


def test_a_table_elsewhere_is_refused(config: CellConfig) -> None:
    lower = config.model_copy(update={"table": config.table.model_copy(update={"height_m": 0.0})})
    with open_cell(lower) as cell:
        moved = Cell(
            config.model_copy(update={"table": config.table.model_copy(update={"height_m": 0.02})}),
            cell.arm,
            cell.gripper,
            cell.camera,
            cell.clock,
        )
        with pytest.raises(CalibrationError, match=r"-20\.\d mm off"):
            look(moved)


def test_a_blind_camera_is_refused(config: CellConfig) -> None:
    with open_cell(config) as cell:
        away = config.model_copy(update={"workspace": config.workspace.model_copy(update={"x": (0.2, 0.7)})})
        with pytest.raises(DeviceFault, match="of the workspace"):
            look(Cell(away, cell.arm, cell.gripper, cell.camera, cell.clock))


def test_an_interrupt_in_motion_leaves_a_standing_arm_and_a_latch(config: CellConfig) -> None:
    from robotcell.primitives import plan_action

    with open_cell(config) as cell:
        view = look(cell)
        guard = Guard(config)
        executor = Executor(cell, guard)
        (action,) = (grasp_at(*RED)(Observation(view.heightmap, view.segmentation.labels, None, (), True)),)
        checked = check_plan(plan_action(action, view.heightmap, cell.arm.state().q, config), config)
        calls = 0

        def interrupted_kick() -> None:
            nonlocal calls
            calls += 1
            if calls == 60:
                raise KeyboardInterrupt
            kick()

        kick = cell.arm.kick
        cell.arm.kick = interrupted_kick  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            executor.run(checked)
        assert not cell.arm.moving
        cell.clock.sleep(0.05)
        np.testing.assert_allclose(cell.arm.state().qd, 0, atol=0.02)
        with pytest.raises(GuardTripped, match="recover"):
            executor.run(checked)
        executor.recover()
        assert guard.violation is None


def test_an_object_is_missed_even_when_another_fell_into_its_place(config: CellConfig) -> None:
    with open_cell(config) as cell:
        view = look(cell)
        action = grasp_at(*RED)(Observation(view.heightmap, view.segmentation.labels, None, (), True))
        # The blue cube now stands where the red one stood.
        shift = round((RED[1] - BLUE[1]) / config.workspace.resolution_m)
        after = replace(
            view,
            heightmap=replace(view.heightmap, height_m=np.roll(view.heightmap.height_m, shift, axis=0)),
            segmentation=replace(
                view.segmentation,
                labels=np.where(
                    np.roll(view.segmentation.labels, shift, axis=0) == find_goal(view.segmentation, "blue").label,
                    find_goal(view.segmentation, "blue").label,
                    0,
                ).astype(np.int32),
            ),
        )
        outcome = judge(Decision(1, "red", view, action), after, Execution(Ending.DONE, "home", 0.0, 0.05))
    assert outcome.result is Result.PICKED


def test_a_held_object_that_the_camera_does_not_miss_is_unconfirmed(config: CellConfig) -> None:
    with open_cell(config) as cell:
        view = look(cell)
        action = grasp_at(*RED)(Observation(view.heightmap, view.segmentation.labels, None, (), True))
        execution = Execution(Ending.DONE, "home", 0.0, 0.05)
        outcome = judge(Decision(1, "red", view, action), look(cell), execution)
    assert outcome.result is Result.UNCONFIRMED
