"""What every `Gripper` does. Nothing stands between its fingers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from robotcell.config.fingers import gripper_range
from robotcell.errors import ConnectionLost, DeviceFault, UnsafeMotion
from sim_twin.wire.faults import Fault, Kind

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.cell import Cell
    from robotcell.interfaces import Gripper
    from sim_twin.wire.cell import ServedCell

PERIOD_S = 0.008
LIMIT_S = 10.0


def test_connects_once_and_closes_twice(closed_cell: Cell) -> None:
    gripper = closed_cell.gripper
    gripper.close()
    with gripper as entered:
        assert entered is gripper
        gripper.connect()
        assert not gripper.state().busy
    gripper.close()
    with pytest.raises(ConnectionLost):
        gripper.state()


def test_refuses_everything_before_it_is_connected(closed_cell: Cell) -> None:
    gripper = closed_cell.gripper
    for call in (gripper.state, gripper.range, gripper.stop, lambda: gripper.start_width(0.05, 20.0)):
        with pytest.raises(ConnectionLost):
            call()


def test_reports_the_range_that_its_backend_says_it_has(cell: Cell) -> None:
    reach = cell.gripper.range()
    assert reach == gripper_range(cell.config)
    assert 0.0 <= reach.min_width_m < cell.gripper.state().width_m <= reach.max_width_m


def test_recover_works_without_a_connection(closed_cell: Cell) -> None:
    closed_cell.gripper.recover()
    with pytest.raises(ConnectionLost):
        closed_cell.gripper.state()
    with closed_cell.gripper as gripper:
        assert not gripper.state().busy


def test_recover_leaves_a_gripper_that_is_free_as_it_is(closed_cell: Cell) -> None:
    with closed_cell.gripper as gripper:
        before = gripper.state().width_m
        gripper.recover()
        state = gripper.state()
    assert not state.busy
    assert state.width_m == pytest.approx(before, abs=0.0005)


def test_recover_leaves_a_fault_once_its_cause_is_gone(closed_cell: Cell, served: ServedCell) -> None:
    with closed_cell.gripper as gripper:
        served.inject(Fault("gripper", "state", Kind.WRONG, "s1"))
        try:
            until(closed_cell, lambda: "still pushed" in fault_of(gripper))
            with pytest.raises(DeviceFault) as refusal:
                gripper.start_width(0.05, 20.0)
            assert refusal.value.device == "gripper"
        finally:
            served.clear()
        # The switch is free, and the fault stays until an operator asks for `recover`.
        until(closed_cell, lambda: "still pushed" not in fault_of(gripper))
        assert "S1 has tripped" in fault_of(gripper)
        gripper.recover()
        assert not gripper.state().busy
        gripper.start_width(0.05, 20.0)
        finish(closed_cell)
        assert gripper.state().width_m == pytest.approx(0.05, abs=0.001)


# Tips that reach inwards keep a gripper from its widest.
@pytest.mark.parametrize("width", [0.0, 0.03, 0.08])
def test_goes_to_a_width_and_says_when_it_is_there(cell: Cell, width: float) -> None:
    begin = cell.clock.now()
    cell.gripper.start_width(width, 20.0)
    finish(cell)
    state = cell.gripper.state()
    assert state.width_m == pytest.approx(width, abs=0.001)
    assert not state.grip_detected
    assert begin < state.t <= cell.clock.now()


def test_the_same_command_twice_is_the_same_as_once(cell: Cell) -> None:
    cell.gripper.start_width(0.05, 20.0)
    cell.clock.sleep(0.1)
    cell.gripper.start_width(0.05, 20.0)
    finish(cell)
    cell.gripper.start_width(0.05, 20.0)
    cell.clock.sleep(0.1)
    state = cell.gripper.state()
    assert not state.busy
    assert not state.grip_detected
    assert state.width_m == pytest.approx(0.05, abs=0.001)


def test_a_new_command_replaces_the_old_one(cell: Cell) -> None:
    cell.gripper.start_width(0.0, 20.0)
    cell.clock.sleep(0.2)
    cell.gripper.start_width(0.08, 20.0)
    finish(cell)
    assert cell.gripper.state().width_m == pytest.approx(0.08, abs=0.001)


def test_stop_leaves_the_fingers_where_they_are(cell: Cell) -> None:
    start = cell.gripper.state().width_m
    cell.gripper.start_width(0.0, 20.0)
    cell.clock.sleep(0.25)
    cell.gripper.stop()
    cell.clock.sleep(0.1)
    stopped = cell.gripper.state()
    assert 0.005 < stopped.width_m < start - 0.005
    assert not stopped.busy
    assert not stopped.grip_detected
    cell.clock.sleep(0.3)
    assert cell.gripper.state().width_m == pytest.approx(stopped.width_m, abs=0.0005)


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("width", "force"),
    [(-0.001, 20), (0.111, 20), (NAN, 20), (INF, 20), (0.05, 2.9), (0.05, 40.1), (0.05, NAN), (0.05, -20)],
)
def test_refuses_widths_and_forces_that_it_does_not_have(cell: Cell, width: float, force: float) -> None:
    before = cell.gripper.state().width_m
    with pytest.raises(UnsafeMotion):
        cell.gripper.start_width(width, force)
    cell.clock.sleep(0.1)
    assert cell.gripper.state().width_m == pytest.approx(before, abs=0.0005)


def fault_of(gripper: Gripper) -> str:
    """What keeps the gripper from moving; empty if nothing does."""
    try:
        gripper.state()
    except DeviceFault as fault:
        return str(fault)
    return ""


def until(cell: Cell, holds: Callable[[], bool]) -> None:
    """Wait for something that a served cell is told to do."""
    end = cell.clock.now() + LIMIT_S
    while not holds():
        assert cell.clock.now() < end
        cell.clock.sleep(PERIOD_S)


def finish(cell: Cell) -> None:
    """Wait as the executor does: a command needs a moment before the fingers say that they move."""
    cell.clock.sleep(PERIOD_S)
    while cell.gripper.state().busy:
        cell.clock.sleep(PERIOD_S)
