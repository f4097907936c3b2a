"""Masks, and what they select from Q maps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from policy.learned.selection import best_cells, check_maps, middles, possible_pushes, push_mask, pushes, surface_at
from policy.push.line import free_to_descend
from robotcell.config import CellConfig
from robotcell.errors import ConfigError


def test_maps_that_say_something_pass():
    maps = np.random.default_rng(0).random((8, 4, 4), np.float32)
    maps[:, 0, 0] = np.nan  # nobody asked
    check_maps(maps, np.arange(16).reshape(4, 4) > 0, "grasp")


def test_a_single_place_to_push_is_not_flat():
    maps = np.full((16, 4, 4), np.nan, np.float32)
    possible = np.zeros(maps.shape, np.bool_)
    possible[3, 1, 2], maps[3, 1, 2] = True, 0.5
    check_maps(maps, possible, "push")


@pytest.mark.parametrize(
    ("maps", "problem"),
    [
        (np.zeros((8, 0, 0), np.float32), "empty"),
        (np.full((8, 4, 4), 0.5, np.float32), "flat"),
        (np.full((8, 4, 4), np.nan, np.float32), "not finite"),
        (np.array([[[0.1, np.inf]]], np.float32), "1 values that are not finite"),
    ],
    ids=["empty", "flat", "nan", "one inf"],
)
def test_maps_that_say_nothing_are_refused(maps, problem):
    with pytest.raises(ConfigError, match=f"push maps .*{problem}"):
        check_maps(maps, np.ones(maps.shape[1:], np.bool_), "push")


def test_maps_that_say_nothing_inside_the_mask_are_refused():
    maps = np.random.default_rng(0).random((8, 4, 4), np.float32)
    inside = np.arange(16).reshape(4, 4) > 11
    maps[:, inside] = 0.5
    with pytest.raises(ConfigError, match="grasp maps are flat"):
        check_maps(maps, inside, "grasp")
    with pytest.raises(ConfigError, match=r"grasp maps are empty.* with 0 cells asked for"):
        check_maps(maps, np.zeros((4, 4), np.bool_), "grasp")


@given(
    q=hnp.arrays(np.float32, (3, 5, 6), elements=st.floats(-2, 2, width=32)),
    mask=hnp.arrays(np.bool_, (5, 6)),
    count=st.integers(1, 40),
)
def test_the_best_cells_are_the_largest_values_inside_the_mask(q, mask, count):
    found = list(zip(*best_cells(q, mask, count), strict=True))
    values = np.sort(q[:, mask].ravel())[::-1][:count]
    assert [value for *_, value in found] == values.tolist()
    for k, row, col, value in found:
        assert mask[row, col]
        assert q[k, row, col] == value
    assert len({place[:3] for place in found}) == len(found)


def test_a_mask_may_differ_from_rotation_to_rotation():
    q = np.arange(8, dtype=np.float32).reshape(2, 2, 2)
    mask = np.zeros((2, 2, 2), np.bool_)
    mask[0, 1, 0] = True
    assert list(zip(*best_cells(q, mask, 3), strict=True)) == [(0, 1, 0, 2.0)]


def test_pushes_concern_the_target_and_what_stands_within_30_mm_of_it():
    objects = np.zeros((100, 100), np.bool_)
    objects[40:60, 40:60] = objects[40:60, 62:90] = True
    target = np.zeros_like(objects)
    target[40:60, 40:60] = True
    mask = push_mask(target, objects)
    assert mask[50, 50]
    assert mask[50, 74]
    assert not mask[50, 75]
    assert not mask[50, 61]  # nothing stands there


def test_the_surface_is_the_median_of_what_was_seen_around_a_cell():
    heights = np.full((9, 9), np.nan, np.float32)
    heights[4, 3:6] = 0.05, 0.30, 0.05
    assert surface_at(heights, (4, 4)) == pytest.approx(0.05)
    assert surface_at(heights, (0, 8)) == 0.0


def test_the_middle_of_an_object_is_that_of_its_cells():
    labels = np.zeros((20, 30), np.int32)
    labels[2:5, 4:9] = 1
    labels[10:20, 20:22] = 3
    found = middles(labels)
    assert found.shape == (20, 30, 2)
    np.testing.assert_array_equal(found[labels == 1], np.broadcast_to([3, 6], (15, 2)))
    np.testing.assert_array_equal(found[labels == 3], np.broadcast_to([14.5, 20.5], (20, 2)))


CONFIG = CellConfig()
PUSH_M, RESOLUTION_M = CONFIG.motion.push_m, CONFIG.workspace.resolution_m
BLOCK = np.s_[90:134, 90:134]
MIDDLE = (111.5, 111.5)


def proposed(q, *, wall=None, lanes=1, beside=99):
    """Pushes of a block of 88 x 88 mm in the middle of the table, with or without a wall."""
    height_m = np.zeros(CONFIG.workspace.shape, np.float32)
    height_m[BLOCK] = 0.05
    mask = height_m > 0
    if wall:
        height_m[wall] = 0.05
    free = free_to_descend(height_m, CONFIG.workspace)
    middle = np.broadcast_to(np.array(MIDDLE), (*height_m.shape, 2))
    maps = np.broadcast_to(q, (16, *height_m.shape)) * mask
    possible = possible_pushes(mask, middle, free, PUSH_M, RESOLUTION_M, beside)
    return list(pushes(maps, possible, middle, height_m, free, PUSH_M, RESOLUTION_M, lanes))


def test_where_all_pushes_are_worth_the_same_they_go_through_the_middle():
    found = proposed(np.float32(0.5))
    assert [push.rotation for push in found] == list(range(16))
    for push in found:
        way = push.line.cells - np.array(MIDDLE)
        assert np.hypot(*way.T).min() < 3
        assert push.q == 0.5


def test_a_better_push_farther_aside_is_taken_and_a_slightly_better_one_is_not():
    much, little = np.full((2, *CONFIG.workspace.shape), 0.3, np.float32)
    much[95:100] = 0.9
    little[95:100] = 0.35
    (aside,) = (push for push in proposed(much) if push.rotation == 0)
    (through,) = (push for push in proposed(little) if push.rotation == 0)
    assert 95 <= aside.cell[0] < 100
    assert aside.q == pytest.approx(0.9)
    assert abs(through.cell[0] - MIDDLE[0]) < 3


def test_no_push_is_looked_for_far_beside_the_middle():
    much = np.full(CONFIG.workspace.shape, 0.3, np.float32)
    much[95:100] = 0.9
    (near,) = (push for push in proposed(much, beside=8) if push.rotation == 0)
    assert abs(near.cell[0] - MIDDLE[0]) <= 8
    assert near.q == pytest.approx(0.3)


def test_where_none_near_the_middle_begins_pushes_farther_beside_are_looked_for():
    # Leaves only the rows from 127 on, 16 and more beside the middle.
    (far,) = (push for push in proposed(np.float32(0.5), wall=np.s_[60:120, 30:90], beside=8) if push.rotation == 0)
    assert 126 <= far.cell[0] <= 126 + 8


def test_a_direction_without_a_place_to_begin_has_no_push():
    # Beside the block at its smaller columns, all along the way back.
    found = proposed(np.float32(0.5), wall=np.s_[60:164, 30:90])
    assert 0 not in {push.rotation for push in found}
    assert 8 in {push.rotation for push in found}


def test_more_lanes_lie_side_by_side():
    one, many = proposed(np.float32(0.5)), proposed(np.float32(0.5), lanes=4)
    assert len(many) == 64
    for rotation in range(16):
        ways = [push for push in many if push.rotation == rotation]
        assert ways[0].cell == one[rotation].cell
        theta = rotation * np.pi / 8
        aside = [push.cell[0] * np.cos(theta) - push.cell[1] * np.sin(theta) for push in ways]
        assert np.diff(np.sort(aside)).min() > 3
