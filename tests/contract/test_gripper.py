"""What every `Gripper` does. Nothing stands between its fingers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from robotcell.errors import ConnectionLost, UnsafeMotion

if TYPE_CHECKING:
    from robotcell.cell import Cell

PERIOD_S = 0.008


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
    for call in (gripper.state, gripper.stop, lambda: gripper.start_width(0.05, 20.0)):
        with pytest.raises(ConnectionLost):
            call()


@pytest.mark.parametrize("width", [0.0, 0.03, 0.11])
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
    cell.gripper.start_width(0.1, 20.0)
    finish(cell)
    assert cell.gripper.state().width_m == pytest.approx(0.1, abs=0.001)


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


def finish(cell: Cell) -> None:
    """Wait as the executor does: a command needs a moment before the fingers say that they move."""
    cell.clock.sleep(PERIOD_S)
    while cell.gripper.state().busy:
        cell.clock.sleep(PERIOD_S)
