"""What every `Clock` does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from robotcell.cell import Cell


def test_time_passes_by_what_was_slept(cell: Cell) -> None:
    begin = cell.clock.now()
    for _ in range(50):
        cell.clock.sleep(0.003)
    assert cell.clock.now() - begin >= 0.15 - 0.005


def test_sleeping_for_no_time_is_allowed(cell: Cell) -> None:
    begin = cell.clock.now()
    cell.clock.sleep(0.0)
    assert cell.clock.now() >= begin


@pytest.mark.parametrize("dt", [-0.001, float("nan"), float("inf")])
def test_refuses_to_sleep_for_a_time_that_is_none(cell: Cell, dt: float) -> None:
    with pytest.raises(ValueError, match="sleep"):
        cell.clock.sleep(dt)
