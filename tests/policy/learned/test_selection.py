"""What is read off Q maps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from policy.learned.selection import best_cells, check_maps, surface_at
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


def test_the_surface_is_the_median_of_what_was_seen_around_a_cell():
    heights = np.full((9, 9), np.nan, np.float32)
    heights[4, 3:6] = 0.05, 0.30, 0.05
    assert surface_at(heights, (4, 4), 0.002) == pytest.approx(0.05)
    assert surface_at(heights, (0, 8), 0.002) == 0.0
