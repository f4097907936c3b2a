"""The executor in the twin: a load that is lost on the way, and what is left of a stop."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from robotcell.cell import Cell, open_cell
from robotcell.config import load_config
from robotcell.errors import GuardTripped, UnsafeMotion
from robotcell.motion.executor import PERIOD_S, Ending
from robotcell.motion.grasp import LOAD_REACH_M
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import CheckHold, Grip, MotionPlan, Step, home_move, joint_move

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    runs = tmp_path_factory.mktemp("runs")
    with open_cell(load_config(None, {"backend.options.objects": 1, "journal.runs": str(runs)})) as opened:
        yield opened


@pytest.fixture(autouse=True)
def at_home(cell: Cell) -> Iterator[None]:
    yield
    cell.latch.clear()
    cell.arm.recover()
    cell.home()


class Losing:
    """The cell's gripper, which loses what it holds once the arm has turned by so much."""

    def __init__(self, cell: Cell, after_rad: float) -> None:
        self._cell, self._after_rad = cell, after_rad
        self._q = cell.arm.state().q
        self.asked: list[float] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cell.gripper, name)

    def state(self) -> Any:
        state = self._cell.arm.state()
        self.asked.append(state.t)
        lost = float(np.abs(state.q - self._q).max()) > self._after_rad
        return replace(self._cell.gripper.state(), width_m=0.0 if lost else 0.04)


def carry(cell: Cell, *after: Step) -> MotionPlan:
    """Half a radian to the side, with a load."""
    q = cell.arm.state().q
    away = q + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    moved = joint_move("carry to bin", away, cell.config, load_m=LOAD_REACH_M)
    return MotionPlan("grasp", q, (CheckHold("held", 0.005), moved, *after))


def run(cell: Cell, plan: MotionPlan, **devices: Any) -> Any:
    changed = replace(cell, devices=replace(cell.devices, **devices))
    return changed.executor.run(check_path(plan, cell.config))


def test_a_load_that_is_lost_on_the_way_ends_the_motion_there(cell: Cell) -> None:
    gripper = Losing(cell, 0.2)
    start = cell.arm.state().q
    execution = run(cell, carry(cell, CheckHold("held over the bin", 0.005), home_move(cell.config)), gripper=gripper)
    assert (execution.ending, execution.step, execution.width_m) == (Ending.EMPTY, "carry to bin", 0.0)
    # The arm stands, where it lost it and by the way of a brake, and nothing is latched: it is an outcome, no fault.
    assert not cell.arm.moving
    assert 0.2 < float(np.abs(cell.arm.state().q - start).max()) < 0.35
    assert cell.latch.violation is None
    # It was asked all the way, and not in every period.
    gaps = np.diff(gripper.asked)
    assert gaps.max() < 0.06
    assert np.median(gaps) > 2 * PERIOD_S


def test_what_is_held_all_the_way_ends_as_before(cell: Cell) -> None:
    execution = run(cell, carry(cell), gripper=Losing(cell, math.inf))
    assert (execution.ending, execution.width_m) == (Ending.DONE, 0.04)


def test_fingers_that_carry_nothing_are_not_asked(cell: Cell) -> None:
    gripper = Losing(cell, 0.1)
    q = cell.arm.state().q
    away = joint_move("move", q + np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]), cell.config)
    assert run(cell, MotionPlan("move", q, (away,)), gripper=gripper).ending is Ending.DONE
    assert gripper.asked == []


def test_every_motion_is_as_much_slower_as_the_file_says(cell: Cell) -> None:
    def lasts(fraction: float, angle: float) -> float:
        motion = cell.config.motion.model_copy(update={"speed_fraction": fraction})
        slow = replace(cell, config=cell.config.model_copy(update={"motion": motion}))
        began, q = slow.clock.now(), slow.arm.state().q
        slow.move(joints=q + np.array([angle, 0.0, 0.0, 0.0, 0.0, 0.0]))
        return slow.clock.now() - began

    assert lasts(0.25, -0.2) == pytest.approx(4 * lasts(1.0, 0.2), rel=0.1)


class Striking:
    """The cell's arm, whose tool meets something once it has turned by so much."""

    def __init__(self, cell: Cell, after_rad: float, force_n: float) -> None:
        self._arm, self._after_rad, self._force_n = cell.arm, after_rad, force_n
        self._q = cell.arm.state().q

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def state(self) -> Any:
        state = self._arm.state()
        strikes = float(np.abs(state.q - self._q).max()) > self._after_rad
        wrench = np.array([self._force_n, 0.0, 0.0, 0.0, 0.0, 0.0])
        return replace(state, wrench=wrench) if strikes else state


def test_the_last_second_before_a_stop_is_kept_and_the_error_names_it(cell: Cell, tmp_path: Path) -> None:
    with cell.recorder.into(tmp_path), pytest.raises(GuardTripped, match="120 N") as tripped:
        run(cell, carry(cell), arm=Striking(cell, 0.45, 120.0), gripper=Losing(cell, math.inf))
    assert cell.recorder.folder is None
    assert not cell.arm.moving
    (path,) = tmp_path.glob("*.csv")
    assert str(path) in str(tripped.value)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    t = np.array([float(row["t_s"]) for row in rows])
    force = np.array([float(row["fx_n"]) for row in rows])
    # Time 0 is the stop: before it up to a second, after it the braking.
    assert -1.0 <= t[0] < -0.3
    assert (np.diff(t) >= 0).all()
    assert np.median(np.diff(t)) == pytest.approx(PERIOD_S, abs=0.002)
    assert force[t < -0.05].max() == 0.0
    assert force[t >= 0].min() == 120.0
    speeds = np.array([float(row["qd1_rad_s"]) for row in rows])
    assert abs(speeds[-1]) < 0.15 < abs(speeds[t <= 0][-1])
    assert {row["mode"] for row in rows} == {"ready"}
    assert float(rows[0]["width_m"]) == 0.04
    picture = cv2.imread(str(path.with_suffix(".png")))
    assert picture is not None
    assert picture.std() > 10


def test_a_stop_that_cannot_be_written_down_is_a_stop_all_the_same(cell: Cell, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with cell.recorder.into(tmp_path / "file"), pytest.raises(GuardTripped, match="could not be written"):
        run(cell, carry(cell), arm=Striking(cell, 0.2, 120.0), gripper=Losing(cell, math.inf))
    assert not cell.arm.moving
    assert cell.latch.violation is not None


def test_a_refused_start_leaves_no_record(cell: Cell, tmp_path: Path) -> None:
    plan = MotionPlan("test", cell.arm.state().q + 0.1, (Grip("grip", 0.05, 20.0),))
    with cell.recorder.into(tmp_path), pytest.raises(UnsafeMotion):
        cell.executor.run(check_path(plan, cell.config))
    assert list(tmp_path.iterdir()) == []


class Pressing:
    """The cell's arm, which feels a force as long as the fingers are narrower than a width."""

    def __init__(self, cell: Cell, narrower_m: float, force_n: float) -> None:
        self._cell, self._narrower_m, self._force_n = cell, narrower_m, force_n

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cell.arm, name)

    def state(self) -> Any:
        state = self._cell.arm.state()
        # It leaned on something before the fingers moved.
        force = self._force_n if self._cell.gripper.state().width_m < self._narrower_m else 40.0
        return replace(state, wrench=np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]))


def test_fingers_that_press_too_hard_open_before_the_guard_stops_the_cell(cell: Cell) -> None:
    motion, limits = cell.config.motion, cell.config.limits
    total = 40.0 + motion.closing_force_n + 2.0
    assert total > limits.force_n
    plan = MotionPlan("grasp", cell.arm.state().q, (Grip("close", 0.0, 20.0, motion.closing_force_n),))
    before = cell.gripper.state().width_m
    execution = run(cell, plan, arm=Pressing(cell, 0.03, total))
    assert execution.ending is Ending.CONTACT
    assert execution.peak_force_n == pytest.approx(motion.closing_force_n + 2.0)
    assert cell.gripper.state().width_m == pytest.approx(before, abs=0.002)
    assert cell.latch.violation is None
