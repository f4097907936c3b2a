"""Turned copies of a map, and the way back."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from policy.network.rotation import Copies, turn_matrix
from robotcell.motion.rotations import ROTATIONS

ROWS, COLS = 24, 30

MASKS = hnp.arrays(np.bool_, (ROWS, COLS), elements=st.booleans(), fill=st.just(False)).filter(np.any)


def places(copies):
    """(K, 2, N) column and row of the cells in the copies."""
    return copies.matrices @ np.stack([copies.cols, copies.rows, np.ones(len(copies.rows))])


@given(MASKS, st.integers(1, 30))
def test_the_values_of_turned_planes_are_those_of_the_cells(mask, margin):
    copies = Copies.around(mask, range(ROTATIONS), margin)
    rows, cols = np.nonzero(mask)
    planes = np.indices(mask.shape).astype(np.float32)
    turned = copies.turn(planes)
    assert turned.shape == (ROTATIONS, 2, *copies.shape)
    row, col = copies.values(turned[:, 0]), copies.values(turned[:, 1])
    # Between quarter turns, the nearest cell of the copy may show a neighbour (or what is beyond the map: 0).
    inside = (rows > 0) & (rows < ROWS - 1) & (cols > 0) & (cols < COLS - 1)
    assert np.abs(row - rows)[:, inside].max(initial=0) <= 1
    assert np.abs(col - cols)[:, inside].max(initial=0) <= 1
    assert np.array_equal(row[:: ROTATIONS // 4], np.broadcast_to(rows, (4, len(rows))))
    assert np.array_equal(col[:: ROTATIONS // 4], np.broadcast_to(cols, (4, len(cols))))


@given(MASKS, st.integers(0, 30), st.integers(0, ROTATIONS - 1), st.integers(1, ROTATIONS))
def test_every_cell_has_its_margin(mask, margin, first, count):
    copies = Copies.around(mask, range(first, first + count), margin)
    rows, cols = copies.shape
    assert rows % 16 == cols % 16 == 0
    assert len(copies.matrices) == count
    at = places(copies)
    assert at.min() > margin - 1e-9
    assert (at.max(axis=(0, 2)) < np.array([cols, rows]) - margin + 1e-9).all()


@given(hnp.arrays(np.bool_, (ROTATIONS, ROWS, COLS)).filter(lambda masks: masks.any(axis=(1, 2)).all()))
def test_each_rotation_may_be_asked_for_cells_of_its_own(masks):
    copies = Copies.around(masks, range(ROTATIONS), 4)
    shown = copies.turn(np.ones((1, ROWS, COLS), np.float32))
    asked = masks[:, copies.rows, copies.cols]
    values = copies.values(shown[:, 0])
    np.testing.assert_array_equal(np.isfinite(values), asked)
    inside = (copies.rows > 0) & (copies.rows < ROWS - 1) & (copies.cols > 0) & (copies.cols < COLS - 1)
    assert (values[asked & inside] == 1).all()


def test_copies_of_strips_are_low():
    strips = np.zeros((ROTATIONS, 96, 96), np.bool_)
    rows, cols = np.indices(strips.shape[1:]) - 48
    for k in range(ROTATIONS):
        theta = math.tau * k / ROTATIONS
        strips[k] = np.abs(rows * math.cos(theta) - cols * math.sin(theta)) <= 6
        strips[k] &= rows**2 + cols**2 < 40**2
    assert Copies.around(strips, range(ROTATIONS), 8).shape == (32, 96)


@given(st.integers(0, ROTATIONS - 1), st.tuples(st.integers(0, 50), st.integers(0, 50)), st.floats(-20, 20))
def test_direction_k_is_plus_x_in_copy_k(rotation, cell, distance):
    M = turn_matrix(rotation, cell, (7.0, 9.0))
    angle = math.tau * rotation / ROTATIONS
    # Rows run along base y and columns along base x.
    ahead = (cell[1] + distance * math.cos(angle), cell[0] + distance * math.sin(angle), 1)
    assert M @ ahead == pytest.approx([9 + distance, 7])


@pytest.mark.parametrize("rotation", range(ROTATIONS))
def test_what_lies_in_direction_k_is_seen_ahead_in_copy_k(rotation):
    mask = np.zeros((64, 64), np.bool_)
    mask[32, 30] = True
    angle = math.tau * rotation / ROTATIONS
    planes = np.zeros((2, 64, 64), np.float32)
    row, col = round(32 + 15 * math.sin(angle)), round(30 + 15 * math.cos(angle))
    planes[:, row - 1 : row + 2, col - 1 : col + 2] = 1
    copies = Copies.around(mask, range(ROTATIONS), 24)
    seen_row, seen_col = (seen.mean() for seen in np.nonzero(copies.turn(planes)[rotation, 0]))
    at_col, at_row = places(copies)[rotation, :, 0]
    assert seen_row == pytest.approx(at_row, abs=1.0)
    assert seen_col - at_col == pytest.approx(15, abs=1.0)


def test_the_world_beyond_the_map_is_0():
    mask = np.zeros((20, 20), np.bool_)
    mask[0, 0] = True
    turned = Copies.around(mask, range(ROTATIONS), 16).turn(np.ones((2, 20, 20), np.float32))
    assert set(np.unique(turned)) == {0.0, 1.0}
    # A quarter of what surrounds a corner is on the map.
    assert turned.mean(axis=(1, 2, 3)) == pytest.approx(0.25, abs=0.05)
