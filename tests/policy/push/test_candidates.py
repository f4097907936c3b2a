"""Which pushes are predicted."""

import math

import numpy as np
import pytest

from policy.push.candidates import cells_with_start, object_centers, push_candidates, pushable_cells
from policy.push.line import free_to_descend
from robotcell.config import CellConfig

CONFIG = CellConfig()
PUSH_M, RESOLUTION_M = CONFIG.motion.push_m, CONFIG.workspace.resolution_m


def test_pushes_concern_the_target_and_what_stands_within_30_mm_of_it():
    objects = np.zeros((100, 100), np.bool_)
    objects[40:60, 40:60] = objects[40:60, 62:90] = True
    target = np.zeros_like(objects)
    target[40:60, 40:60] = True
    mask = pushable_cells(target, objects, RESOLUTION_M)
    assert mask[50, 50]
    assert mask[50, 74]
    assert not mask[50, 75]
    assert not mask[50, 61]  # nothing stands there


def test_the_center_of_an_object_is_that_of_its_cells():
    labels = np.zeros((20, 30), np.int32)
    labels[2:5, 4:9] = 1
    labels[10:20, 20:22] = 3
    found = object_centers(labels)
    assert found.shape == (20, 30, 2)
    np.testing.assert_array_equal(found[labels == 1], np.broadcast_to([3, 6], (15, 2)))
    np.testing.assert_array_equal(found[labels == 3], np.broadcast_to([14.5, 20.5], (20, 2)))


BLOCK = np.s_[90:134, 90:134]
MIDDLE = (111.5, 111.5)


def proposed(q, *, wall=None, lanes=1, off_center_m=math.inf):
    """Pushes of a block of 88 x 88 mm in the middle of the table, with or without a wall."""
    height_m = np.zeros(CONFIG.workspace.shape, np.float32)
    height_m[BLOCK] = 0.05
    mask = height_m > 0
    if wall:
        height_m[wall] = 0.05
    free = free_to_descend(height_m, CONFIG.workspace)
    middle = np.broadcast_to(np.array(MIDDLE), (*height_m.shape, 2))
    maps = np.broadcast_to(q, (16, *height_m.shape)) * mask
    possible = cells_with_start(mask, middle, free, PUSH_M, RESOLUTION_M, off_center_m)
    return list(push_candidates(maps, possible, middle, height_m, free, PUSH_M, RESOLUTION_M, lanes))


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
    (near,) = (push for push in proposed(much, off_center_m=0.016) if push.rotation == 0)
    assert abs(near.cell[0] - MIDDLE[0]) <= 8
    assert near.q == pytest.approx(0.3)


def test_where_none_near_the_middle_begins_pushes_farther_beside_are_looked_for():
    # Leaves only the rows from 127 on, 16 and more beside the middle.
    (far,) = (
        push for push in proposed(np.float32(0.5), wall=np.s_[60:120, 30:90], off_center_m=0.016) if push.rotation == 0
    )
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


def test_distances_are_in_metres():
    objects = np.zeros((50, 50), np.bool_)
    objects[20:30, 20:30] = objects[20:30, 31:45] = True
    target = np.zeros_like(objects)
    target[20:30, 20:30] = True
    mask = pushable_cells(target, objects, 2 * RESOLUTION_M)
    # 30 mm are 7.5 cells of 4 mm.
    assert mask[25, 36]
    assert not mask[25, 39]
