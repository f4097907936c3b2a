"""What every `Camera` does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.cell import open_cell
from robotcell.errors import ConnectionLost

if TYPE_CHECKING:
    from robotcell.cell import Cell
    from robotcell.config import CellConfig


def test_connects_once_and_closes_twice(closed_cell: Cell) -> None:
    camera = closed_cell.camera
    camera.close()
    with camera as entered:
        assert entered is camera
        camera.connect()
        camera.read()
    camera.close()
    with pytest.raises(ConnectionLost):
        camera.read()


def test_refuses_to_read_before_it_is_connected(closed_cell: Cell) -> None:
    with pytest.raises(ConnectionLost):
        closed_cell.camera.read()


@pytest.mark.parametrize("resolution", ["640x480", "1280x720"])
def test_a_frame_is_what_the_configuration_says(config: CellConfig, resolution: str) -> None:
    mount = config.camera.model_copy(update={"resolution": resolution})
    with open_cell(config.model_copy(update={"camera": mount})) as cell:
        begin = cell.clock.now()
        frame = cell.camera.read()
        width, height = (int(n) for n in resolution.split("x"))
        assert frame.color.shape == (height, width, 3)
        assert frame.color.dtype == np.uint8
        assert frame.depth_m.shape == (height, width)
        assert frame.depth_m.dtype == np.float32
        assert (frame.intrinsics.width, frame.intrinsics.height) == (width, height)
        assert abs(frame.intrinsics.cx - width / 2) < width / 10
        assert 0.5 < frame.intrinsics.fx / width < 1.5
        assert begin <= frame.t <= cell.clock.now()


def test_depth_is_metres_and_zero_where_there_is_none(cell: Cell) -> None:
    depth = cell.camera.read().depth_m
    assert np.isfinite(depth).all()
    assert (depth >= 0).all()
    T = cell.config.camera.pose()
    to_table = (cell.config.table.height_m - T[2, 3]) / T[2, 2]
    middle = depth[220:260, 300:340]
    assert np.median(middle[middle > 0]) == pytest.approx(to_table, abs=0.1)


def test_every_frame_is_newer_than_the_one_before(cell: Cell) -> None:
    first = cell.camera.read()
    second = cell.camera.read()
    assert second.number > first.number
    assert second.t >= first.t
