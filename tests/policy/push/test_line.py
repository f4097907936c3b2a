"""Where a push begins."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.push.line import free_to_descend, push_line
from robotcell.config import Workspace

WORKSPACE = Workspace()
RESOLUTION = WORKSPACE.resolution_m
PUSH_M = 0.10
# Rows and columns of a block of 50 mm in the middle of the map.
BLOCK = slice(100, 125)


def table(*blocks, height=0.05):
    heights = np.zeros(WORKSPACE.shape, np.float32)
    for rows, cols in blocks:
        heights[rows, cols] = height
    return heights


def line_through(heights, cell, rotation):
    return push_line(heights, free_to_descend(heights, WORKSPACE), cell, rotation, PUSH_M, RESOLUTION)


@pytest.mark.parametrize(
    ("rotation", "row", "col"), [(0, 0, -1), (4, -1, 0), (8, 0, 1), (12, 1, 0)], ids=["+x", "+y", "-x", "-y"]
)
def test_the_fingers_come_down_behind_the_block(rotation, row, col):
    found = line_through(table((BLOCK, BLOCK)), (112, 112), rotation)
    assert found is not None
    # Half the block is 12 cells; the fingers need 8 more.
    assert (found.row - 112, found.col - 112) == pytest.approx((21 * row, 21 * col), abs=2)
    assert found.top_m == pytest.approx(0.05)


def test_a_place_between_neighbours_is_taken_before_one_behind_them():
    near = table((BLOCK, BLOCK), (BLOCK, slice(60, 80)))
    far = table((BLOCK, BLOCK), (BLOCK, slice(85, 99)))
    assert line_through(near, (112, 112), 0).col > 80
    assert line_through(far, (112, 112), 0).col < 85


def test_a_push_that_would_end_before_the_cell_does_not_exist():
    wide = table((slice(50, 180), slice(50, 180)))
    assert line_through(wide, (112, 112), 0) is None
    assert line_through(wide, (112, 60), 0) is not None


def test_the_unknown_is_no_place_to_come_down():
    heights = table((BLOCK, BLOCK))
    heights[:, :100] = np.nan
    assert line_through(heights, (112, 112), 0) is None
    assert line_through(heights, (112, 112), 8) is not None


@pytest.mark.parametrize("height", [0.04, 0.10])
def test_the_gripper_does_not_come_down_on_what_is_higher_than_its_fingers(height):
    # The fingers fit between block and wall, and the cranks above them only over a low wall.
    heights = table((BLOCK, BLOCK))
    heights[90:135, 70:81] = height
    found = line_through(heights, (112, 112), 0)
    assert (found is None) == (height > 0.05)


def test_nothing_to_meet_is_no_push():
    assert line_through(table(), (112, 112), 3) is None


def test_the_rim_of_the_map_is_not_free():
    free = free_to_descend(table(), WORKSPACE)
    assert not free[0].any()
    assert not free[:, -1].any()
    assert free[100, 100]


@given(
    row=st.integers(100, 124),
    col=st.integers(100, 124),
    rotation=st.integers(0, 15),
    other=st.tuples(st.integers(20, 190), st.integers(20, 190)),
)
def test_every_line_starts_free_and_passes_through_its_cell(row, col, rotation, other):
    heights = table((BLOCK, BLOCK), (slice(other[0], other[0] + 20), slice(other[1], other[1] + 20)))
    found = line_through(heights, (row, col), rotation)
    if found is None:
        return
    assert free_to_descend(heights, WORKSPACE)[found.row, found.col]
    distance = np.linalg.norm(found.cells - (row, col), axis=1)
    assert distance.min() < 1.5
    assert distance.argmin() * RESOLUTION <= PUSH_M - 0.010 + RESOLUTION
    theta = 2 * math.pi * rotation / 16
    way = found.cells[-1] - found.cells[0]
    assert abs(way[1] * math.sin(theta) - way[0] * math.cos(theta)) < 1.5
    assert way @ (math.sin(theta), math.cos(theta)) <= PUSH_M / RESOLUTION + 1
    assert (found.cells >= 0).all()
    assert (found.cells < WORKSPACE.shape).all()
