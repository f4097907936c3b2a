"""Jobs in the twin, judged against what the simulator knows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from policy import make_policy
from robotcell.cell import Cell, open_cell
from robotcell.config import CellConfig, Workspace, load_config
from robotcell.errors import CalibrationError, DeviceFault, GuardTripped, NoTarget
from robotcell.jobs.job import Report, run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.policy_api import Action, Observation, PickGoal, Uncover
from robotcell.jobs.verdict import Outcome, Result, judge
from robotcell.motion.actions import plan_action
from robotcell.motion.executor import Ending, Execution
from robotcell.motion.grasp import Grasp
from robotcell.motion.path_check import CheckedPlan, check_path
from robotcell.motion.push import Push, push_in_workspace
from robotcell.perception.colors import PALETTE
from robotcell.perception.goals import find_goal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from robotcell.findings import Finding
    from robotcell.interfaces import Camera, Gripper, GripperState, RgbdFrame
    from robotcell.jobs.decision import Decision
    from robotcell.perception.view import View

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


# A job is the same however fast the arm gets to where it acts, and half of a job here is motion through free space.
BRISK = {"motion.joint_acceleration_rad_s2": 4.0, "motion.linear_acceleration_m_s2": 4.0}


@pytest.fixture
def config(tmp_path: Path) -> CellConfig:
    scene = tmp_path / "two-cubes.toml"
    scene.write_text(SCENE)
    return load_config(None, {"backend.options.scene": str(scene), "journal.runs": str(tmp_path / "runs"), **BRISK})


@dataclass
class Scripted:
    """A policy whose actions are functions of what it sees."""

    script: list[Callable[[Observation], Action]]
    name: str = "scripted"
    workspace: Workspace = field(default_factory=Workspace)
    seen: list[Observation] = field(default_factory=list)

    def decide(self, observation: Observation) -> Action:
        self.seen.append(observation)
        if not self.script:
            raise NoTarget("the script is over")
        return self.script.pop(0)(observation)


def grasp_at(x: float, y: float, surface_m: float = 0.05, rotation: int = 0) -> Callable[[Observation], Grasp]:
    return lambda _: Grasp(x, y, surface_m, rotation, 1.0)


def push_at(x: float, y: float, top_m: float = 0.05, rotation: int = 0) -> Callable[[Observation], Push]:
    return lambda observation: push_in_workspace((x, y), rotation, 0.1, top_m, 1.0, observation.heightmap.workspace)


RED, BLUE = (-0.5, 0.06), (-0.5, -0.06)
DONE = Execution(Ending.DONE, "home", 0.0, 0.0, 0.05)


def run(
    config: CellConfig, policy: Scripted, goals: tuple[str, ...] | None, cell: Cell | None = None
) -> tuple[Report, list[Result], Journal]:
    results: list[Result] = []

    class Collector:
        def started(self, job_id: int, run_dir: Path) -> None: ...

        def checked(self, findings: Sequence[Finding]) -> None: ...

        def looked(self, view: View) -> None: ...

        def decided(self, decision: Decision) -> None: ...

        def ended(self, decision: Decision, outcome: Outcome) -> None:
            results.append(outcome.result)

    with Journal(config.journal.database_url()) as journal, cell or open_cell(config) as opened:
        report = run_job(opened, policy, journal, goals, (Collector(),))
    return report, results, journal


def test_a_goal_is_picked_and_confirmed(config: CellConfig) -> None:
    report, results, _ = run(config, Scripted([grasp_at(*RED)]), ("red",))
    assert results == [Result.PICKED]
    assert report.completed
    assert report.metrics.picked == ("red",)
    assert sorted(path.name for path in (report.run_dir / "frames").iterdir())


def test_what_was_decided_and_felt_is_in_the_journal(config: CellConfig) -> None:
    policy = Scripted([push_at(-0.58, -0.06), grasp_at(*RED)])
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        report = run_job(cell, policy, journal, ("red",))
        push, grasp = journal.job(report.job_id).actions
    assert (push.primitive, push.x, push.y, push.surface_m) == ("push", -0.58, -0.06, 0.05)
    assert (push.end_x, push.end_y) == pytest.approx((-0.48, -0.06))
    assert (grasp.primitive, grasp.surface_m, grasp.end_x) == ("grasp", 0.05, None)
    for row in (push, grasp):
        assert row.outcome is not None
        # What was felt is known, though nothing ended the plan. A push closes the fingers in free air.
        assert row.outcome.peak_force_n is not None
    assert push.outcome is not None
    assert push.outcome.grip_force_n is None
    assert grasp.outcome is not None
    assert 0 < (grasp.outcome.grip_force_n or 0) < config.motion.closing_force_n


def test_a_policy_sees_the_map_that_it_declares_and_people_the_one_of_the_file(config: CellConfig) -> None:
    coarse = config.model_copy(update={"workspace": config.workspace.model_copy(update={"resolution_m": 0.004})})
    policy = Scripted([grasp_at(*RED)], workspace=Workspace(resolution_m=0.003))
    report, results, _ = run(coarse, policy, ("red",))
    assert results == [Result.PICKED], report.reason
    assert policy.seen[0].heightmap.workspace.resolution_m == 0.003


@pytest.mark.parametrize(("offset", "preshape"), [(0.02, 0.07), (-0.005, 0.08)])
def test_fingers_with_other_tips_pick(config: CellConfig, offset: float, preshape: float) -> None:
    config.backend.options["fingertip_offset_m"] = offset
    config = config.model_copy(update={"gripper": config.gripper.model_copy(update={"preshape_m": preshape})})
    policy = Scripted([grasp_at(-0.4, 0.0), grasp_at(*RED)])
    report, results, _ = run(config, policy, ("red",))
    # Fingers that close on nothing know it, however far apart their tips then are.
    assert results == [Result.MISSED, Result.PICKED], report.reason


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


def test_fingers_that_press_too_hard_as_they_close_open_again(config: CellConfig) -> None:
    config = config.model_copy(update={"motion": config.motion.model_copy(update={"closing_force_n": 1.0})})
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        report = run_job(cell, Scripted([grasp_at(RED[0] - 0.01, RED[1])]), journal, ("red",))
        (row,) = journal.job(report.job_id).actions
        assert row.outcome is not None
        assert row.outcome.result == Result.COLLIDED.value
        assert "during 'close'" in row.outcome.detail
        assert cell.gripper.state().width_m == pytest.approx(config.gripper.preshape_m, abs=0.002)
        find_goal(cell.look().segmentation, "red")


def test_an_unsafe_action_is_refused_and_nothing_moves(config: CellConfig) -> None:
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        q = cell.arm.state().q
        report = run_job(cell, Scripted([grasp_at(-1.4, 0.0)] * 1), journal, ("red",))
        np.testing.assert_allclose(cell.arm.state().q, q, atol=1e-3)
        (row,) = journal.job(report.job_id).actions
    assert row.outcome is not None
    assert row.outcome.result == "refused"
    assert "cannot reach" in row.outcome.detail


def test_an_action_that_somebody_declines_is_barred_and_another_one_decided(config: CellConfig) -> None:
    # More than the failures that end a job: a no is none.
    policy = Scripted([grasp_at(-0.4, 0.01 * i) for i in range(12)] + [grasp_at(*RED)])
    asked: list[tuple[Decision, CheckedPlan]] = []
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        q = cell.arm.state().q

        def confirm(decision: Decision, plan: CheckedPlan) -> bool:
            np.testing.assert_allclose(cell.arm.state().q, q, atol=1e-3)
            asked.append((decision, plan))
            return len(asked) > 12

        report = run_job(cell, policy, journal, ("red",), confirm=confirm)
        rows = journal.job(report.job_id).actions
    assert report.completed
    assert [row.outcome.result for row in rows if row.outcome] == ["declined"] * 12 + ["picked"]
    assert [len(observation.barred) for observation in policy.seen] == list(range(13))
    assert report.metrics.actions == 1
    assert asked[-1][1].plan.steps[0].label == "pre-shape"


def test_ten_failures_in_a_row_end_the_run(config: CellConfig) -> None:
    report, results, _ = run(config, Scripted([grasp_at(-1.4, 0.0)] * 20), ("red",))
    assert results == [Result.REFUSED] * 10
    assert "10 failed attempts in a row" in report.reason


def test_five_pushes_in_a_row_are_the_most(config: CellConfig) -> None:
    policy = Scripted([push_at(-0.6, -0.15)] * 5 + [grasp_at(*RED)])
    run(config, policy, ("red",))
    assert [observation.may_push for observation in policy.seen] == [True] * 5 + [False]


def test_a_goal_that_is_not_there_ends_the_job_and_lists_what_is(config: CellConfig) -> None:
    report, results, _ = run(config, Scripted([grasp_at(*RED)]), ("red", "green"))
    assert results == [Result.PICKED]
    assert not report.completed
    assert report.reason == "no green object is seen on the table; there is: blue"


class BlueForRed:
    """The cell's camera. In its pictures of some looks, counted from 0, everything red is blue: the goal is hidden."""

    def __init__(self, camera: Camera, looks: set[int]) -> None:
        self._camera, self._looks = camera, looks
        self._count = 0

    def connect(self) -> None:
        self._camera.connect()

    def close(self) -> None:
        self._camera.close()

    def read(self) -> RgbdFrame:
        return self._painted(self._camera.read())

    def poll(self, since: float) -> Callable[[], RgbdFrame] | None:
        develop = self._camera.poll(since)
        return None if develop is None else lambda: self._painted(develop())

    def _painted(self, frame: RgbdFrame) -> RgbdFrame:
        self._count += 1
        if self._count - 1 not in self._looks:
            return frame
        red, green, blue = (frame.color[..., i].astype(int) for i in range(3))
        color = frame.color.copy()
        color[(red > 1.5 * green) & (red > 1.5 * blue)] = PALETTE["blue"]
        return replace(frame, color=color)


class Dropping:
    """The cell's gripper, which says at the second look at its closed fingers that they hold nothing any more."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._closing, self._looks = False, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._gripper, name)

    def start_width(self, width_m: float, force_n: float) -> None:
        self._closing = width_m == 0.0
        self._gripper.start_width(width_m, force_n)

    def state(self) -> GripperState:
        state = self._gripper.state()
        if not self._closing or state.busy:
            return state
        self._looks += 1
        # The first of them ends the wait for the fingers, the second is after the lift.
        return replace(state, width_m=0.0) if self._looks > 2 else state


def open_hiding(config: CellConfig, looks: set[int], *, dropping: bool = False) -> Cell:
    """The twin, whose camera does not show the goal in these looks."""
    cell = open_cell(config)
    camera: Any = BlueForRed(cell.camera, looks)
    gripper: Any = Dropping(cell.gripper) if dropping else cell.gripper
    return Cell(config, replace(cell.devices, camera=camera, gripper=gripper))


def test_what_hides_a_goal_is_pushed_aside_and_never_picked(config: CellConfig) -> None:
    # Beside red, along red to where blue stands, and back.
    pushes = [push_at(-0.6, 0.06, rotation=12), push_at(-0.6, 0.0), push_at(-0.6, 0.0)]
    policy = Scripted([*pushes, grasp_at(*RED)])
    report, results, _ = run(config, policy, ("red",), open_hiding(config, {1, 2}))
    assert [type(seen.task) for seen in policy.seen] == [PickGoal, Uncover, Uncover, PickGoal]
    assert report.completed, (report.reason, results)
    for seen in policy.seen[1:3]:
        assert seen.may_push
        # What stands where the goal may have gone is what may lie on it.
        assert seen.targets()[seen.heightmap.workspace.cell(*RED)]


def test_a_hidden_goal_is_searched_for_by_ten_pushes(config: CellConfig) -> None:
    # Blue goes to and fro.
    to_and_fro = [push_at(-0.58, -0.06), push_at(-0.35, -0.06, rotation=8)] * 10
    policy = Scripted([*to_and_fro])
    report, results, _ = run(config, policy, ("red",), open_hiding(config, set(range(1, 50))))
    assert [type(seen.task) for seen in policy.seen] == [PickGoal] + [Uncover] * 10
    assert results == [Result.PUSHED] * 11
    assert all(seen.may_push for seen in policy.seen)
    assert "10 failed attempts in a row" in report.reason


@pytest.mark.parametrize(("x", "carried"), [(-0.55, True), (-0.65, False)], ids=["beside it", "far from it"])
def test_a_hidden_goal_is_looked_for_where_a_push_may_have_taken_it(
    config: CellConfig, x: float, carried: bool
) -> None:
    # 0.1 m in the direction of -y, past both cubes: from red's place the way reaches blue.
    policy = Scripted([push_at(x, 0.06, rotation=12)])
    run(config, policy, ("red",), open_hiding(config, {1}))
    seen = policy.seen[1]
    assert isinstance(seen.task, Uncover)
    workspace = seen.heightmap.workspace
    assert seen.task.mask[workspace.cell(*RED)]
    assert seen.task.mask[workspace.cell(*BLUE)] == carried


def test_a_goal_that_was_lost_on_its_way_is_not_searched_for(config: CellConfig) -> None:
    policy = Scripted([grasp_at(*RED)] * 2)
    report, results, _ = run(config, policy, ("red",), open_hiding(config, {1}, dropping=True))
    assert results == [Result.LOST]
    assert report.reason.startswith("no red object is seen on the table")


def test_two_looks_at_an_untouched_heap_show_no_push() -> None:
    crowded = load_config(None, {"backend.options.objects": 20, "backend.options.seed": 1})
    with open_cell(crowded) as cell:
        view = cell.look()
        push = Push((-0.72, -0.22), (-0.62, -0.22), 0, 0.05, 1.0)
        outcome = judge(push, None, view, cell.look(), DONE)
    assert outcome.result is Result.NOTHING_MOVED


def test_pushes_do_not_excuse_failed_grasps(config: CellConfig) -> None:
    push = push_at(-0.58, -0.06)
    report, results, _ = run(config, Scripted([push, grasp_at(-1.4, 0.0)] * 40), ("red",))
    assert results.count(Result.REFUSED) + results.count(Result.NOTHING_MOVED) == 10
    assert Result.PUSHED in results
    assert "10 failed attempts" in report.reason


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
        higher = config.model_copy(update={"table": config.table.model_copy(update={"height_m": 0.02})})
        moved = Cell(higher, cell.devices)
        with pytest.raises(CalibrationError, match=r"-20\.\d mm off"):
            moved.look()


def test_a_blind_camera_is_refused(config: CellConfig) -> None:
    with open_cell(config) as cell:
        # Beside the table there is nothing to see.
        aside = config.model_copy(update={"workspace": config.workspace.model_copy(update={"y": (-1.4, -1.0)})})
        with pytest.raises(DeviceFault, match="of the workspace"):
            Cell(aside, cell.devices).look()


def grasp_plan(cell: Cell) -> CheckedPlan:
    view = cell.look()
    plan = plan_action(Grasp(*RED, 0.05, 0, 1.0), view.heightmap, cell.arm.state().q, cell.config)
    return check_path(plan, cell.config)


def interrupt(monkeypatch: pytest.MonkeyPatch, device: object, method: str, call: int) -> None:
    """Raise KeyboardInterrupt in the n-th call of a method."""
    original, count = getattr(device, method), 0

    def interrupted(*arguments: object) -> object:
        nonlocal count
        count += 1
        if count == call:
            raise KeyboardInterrupt
        return original(*arguments)

    monkeypatch.setattr(device, method, interrupted)


def test_an_interrupt_in_motion_leaves_a_standing_arm_and_a_latch(
    config: CellConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_cell(config) as cell:
        executor, checked = cell.executor, grasp_plan(cell)
        interrupt(monkeypatch, cell.arm, "kick", call=60)
        with pytest.raises(KeyboardInterrupt):
            executor.run(checked)
        assert not cell.arm.moving
        cell.clock.sleep(0.05)
        np.testing.assert_allclose(cell.arm.state().qd, 0, atol=0.02)
        # The latch is the cell's: neither another executor nor the next job gets round it.
        with pytest.raises(GuardTripped, match="recover"):
            cell.executor.run(checked)
        with Journal(config.journal.database_url()) as journal, pytest.raises(GuardTripped, match="recover"):
            run_job(cell, Scripted([grasp_at(*RED)]), journal, ("red",))
        cell.recover()
        assert cell.latch.violation is None


def test_an_interrupt_while_the_fingers_close_stops_them(config: CellConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_cell(config) as cell:
        cell.gripper.start_width(0.11, 40.0)
        cell.clock.sleep(1.5)
        checked = grasp_plan(cell)
        interrupt(monkeypatch, cell.gripper, "state", call=5)
        with pytest.raises(KeyboardInterrupt):
            cell.executor.run(checked)
        width = cell.gripper.state().width_m
        cell.clock.sleep(0.5)
        assert cell.gripper.state().width_m == pytest.approx(width, abs=1e-3)
        assert width > 0.082


def test_a_gripper_that_hangs_latches(config: CellConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_cell(config) as cell:
        checked = grasp_plan(cell)
        hung = replace(cell.gripper.state(), busy=True)
        monkeypatch.setattr(cell.gripper, "state", lambda: hung)
        with pytest.raises(DeviceFault, match="still busy"):
            cell.executor.run(checked)
        assert cell.latch.violation is not None
        with pytest.raises(GuardTripped):
            cell.executor.run(checked)


def test_a_paused_motion_is_given_up(config: CellConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_cell(config) as cell:
        checked = grasp_plan(cell)
        # A speed slider at zero: the controller says that it moves, and nothing does.
        monkeypatch.setattr(cell.arm, "start_joints", lambda *_: None)
        monkeypatch.setattr(type(cell.arm), "moving", property(lambda _: True))
        with pytest.raises(GuardTripped, match="stood still"):
            cell.executor.run(checked)


def test_an_arm_in_the_view_is_not_taken_for_objects(config: CellConfig) -> None:
    with open_cell(config) as cell:
        q = np.array(config.motion.home_q) + np.array([0.7, 0, 0, 0, 0, 0])
        cell.arm.start_joints(q, 1.0, 1.0)
        while cell.arm.moving:
            cell.arm.kick()
            cell.clock.sleep(0.05)
        with pytest.raises(DeviceFault, match="between the camera and the workspace"):
            cell.look()


def test_an_object_is_missed_even_when_another_fell_into_its_place(config: CellConfig) -> None:
    with open_cell(config) as cell:
        view = cell.look()
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
        outcome = judge(Grasp(*RED, 0.05, 0, 1.0), "red", view, after, DONE)
    assert outcome.result is Result.PICKED


def test_a_held_object_that_the_camera_does_not_miss_is_unconfirmed(config: CellConfig) -> None:
    with open_cell(config) as cell:
        view = cell.look()
        outcome = judge(Grasp(*RED, 0.05, 0, 1.0), "red", view, cell.look(), DONE)
    assert outcome.result is Result.UNCONFIRMED
