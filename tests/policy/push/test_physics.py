"""Prisms that are pushed over the table."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy.push.physics import PlanarPhysics, Prism

RESOLUTION_M = 0.002
LENGTH_M = 0.10
TIP_M = 0.02


def prism(*boxes, height_m=0.05):
    """Of boxes of cells: first row and column, rows and columns."""
    own = np.zeros((160, 160), np.bool_)
    for row, col, rows, cols in boxes:
        own[row : row + rows, col : col + cols] = True
    return Prism.of(own, (0, 0), height_m, RESOLUTION_M)


def area_m2(of):
    return sum(cv2.contourArea(part.astype(np.float32)) for part in of.parts)


def table():
    return PlanarPhysics({1: prism((60, 60, 25, 25)), 2: prism((60, 90, 25, 25)), 3: prism((90, 70, 30, 20))})


def pushed(by, start, theta, length_m=LENGTH_M):
    return by.push(np.array(start), theta, length_m, TIP_M)


STARTS = st.tuples(st.floats(0.04, 0.28), st.floats(0.04, 0.28))
ANGLES = st.floats(0, math.tau)


def same(moves, others):
    assert moves.keys() == others.keys()
    for label, move in moves.items():
        np.testing.assert_array_equal(move, others[label])


@settings(max_examples=40, derandomize=True, deadline=None)
@given(STARTS, ANGLES, STARTS, ANGLES)
def test_a_push_leaves_nothing_behind_for_the_next(start, theta, other_start, other_theta):
    used = table()
    pushed(used, other_start, other_theta)
    same(pushed(used, start, theta), pushed(table(), start, theta))


@settings(max_examples=40, derandomize=True, deadline=None)
@given(STARTS, ANGLES)
def test_objects_are_turned_and_shifted_and_not_bent(start, theta):
    for move in pushed(table(), start, theta).values():
        np.testing.assert_allclose(move[:2, :2] @ move[:2, :2].T, np.eye(2), atol=1e-9)
        assert np.linalg.det(move) == pytest.approx(1)
        np.testing.assert_array_equal(move[2], [0, 0, 1])


def test_the_way_to_the_first_object_changes_nothing():
    # A whole number of steps nearer.
    one = pushed(table(), (0.02, 0.145), 0.0, 0.16)
    two = pushed(table(), (0.06, 0.145), 0.0, 0.12)
    assert one.keys() == two.keys() == {1, 2}
    for label in one:
        np.testing.assert_allclose(one[label], two[label], atol=5e-4)


def test_what_is_lower_than_the_tips_stays():
    low = PlanarPhysics({1: prism((60, 60, 25, 25), height_m=0.015)})
    assert pushed(low, (0.08, 0.145), 0.0) == {}
    assert pushed(PlanarPhysics({1: prism((60, 60, 25, 25))}), (0.08, 0.145), 0.0).keys() == {1}


def test_what_is_high_is_met_by_the_cranks_above_the_fingers():
    low, high = (
        pushed(PlanarPhysics({1: prism((60, 60, 25, 25), height_m=height_m)}), (0.08, 0.145), 0.0)[1][0, 2]
        for height_m in (0.04, 0.10)
    )
    # They stand out 10 mm farther.
    assert high - low == pytest.approx(0.010, abs=0.002)


def test_an_empty_table_can_be_pushed_over():
    assert pushed(PlanarPhysics({}), (0.1, 0.1), 1.0) == {}


def test_a_speck_is_no_object():
    assert prism((10, 10, 2, 4)) is None


def test_a_convex_outline_is_one_part():
    whole = prism((60, 60, 25, 40))
    (part,) = whole.parts
    assert area_m2(whole) == pytest.approx(24 * 39 * RESOLUTION_M**2, rel=0.01)
    np.testing.assert_allclose(whole.center, (80 * RESOLUTION_M, 72.5 * RESOLUTION_M))
    assert whole.reach_m == pytest.approx(np.hypot(*part.T).max())


@pytest.mark.parametrize(
    "boxes",
    [
        [(20, 20, 60, 12), (68, 20, 12, 60)],
        [(20, 20, 60, 12), (68, 20, 12, 60), (24, 40, 36, 36)],
    ],
    ids=["an angle", "an angle with a piece of its own between its arms"],
)
def test_the_parts_of_a_concave_outline_are_as_large_as_it(boxes):
    own = np.zeros((160, 160), np.bool_)
    for row, col, rows, cols in boxes:
        own[row : row + rows, col : col + cols] = True
    found = prism(*boxes)
    assert len(found.parts) >= len(boxes)
    # Outlines run through the middles of the outermost cells.
    assert area_m2(found) == pytest.approx(np.count_nonzero(own) * RESOLUTION_M**2, rel=0.15)
