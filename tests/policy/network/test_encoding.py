"""What the network is shown of a heightmap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from policy.network.encoding import CHANNELS, encode

SHAPE = (3, 4)
HEIGHTS = hnp.arrays(np.float32, SHAPE, elements=st.one_of(st.floats(-0.125, 0.5, width=32), st.just(np.nan)))
COLORS = hnp.arrays(np.uint8, (*SHAPE, 3))


@given(HEIGHTS, COLORS)
def test_a_hole_is_0_in_every_plane(height_m, color):
    holes = np.isnan(height_m)
    # As in a heightmap: what was not seen is black.
    planes = encode(height_m, np.where(holes[..., None], np.uint8(0), color))
    assert planes.shape == (CHANNELS, *SHAPE)
    assert planes.dtype == np.float32
    assert np.isfinite(planes).all()
    assert not planes[:, holes].any()
    assert (planes[1, ~holes] == 1).all()


@given(HEIGHTS, COLORS)
def test_maps_may_be_stacked(height_m, color):
    planes = encode(height_m, color)
    stacked = encode(np.stack([height_m, height_m[::-1]]), np.stack([color, color[::-1]]))
    assert np.array_equal(stacked, np.stack([planes, planes[:, ::-1]]))


def test_heights_are_in_units_of_5_cm_above_the_table():
    height_m = np.array([[0.1, 0.0, -0.02]], np.float32)
    assert encode(height_m, np.zeros((1, 3, 3), np.uint8))[0, 0] == pytest.approx([2, 0, 0])


def test_colours_go_from_minus_1_to_1():
    color = np.array([[[255, 0, 51], [0, 0, 0]]], np.uint8)
    planes = encode(np.zeros((1, 2), np.float32), color)
    assert planes[2:, 0, 0] == pytest.approx([1, -1, -0.6])
    # A gap that was closed has a height, and no colour.
    assert planes[:, 0, 1].tolist() == [0, 1, 0, 0, 0]
