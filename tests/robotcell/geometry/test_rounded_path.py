from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.geometry import rg2, ur5e
from robotcell.geometry.rounded_path import round_corners

START = np.array([-0.8370, -1.4768, 1.2793, -1.3733, -1.5708, 0.7338])
turns = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6).map(np.array)
radii = st.floats(0.005, 0.15)


def leg(q, turn):
    return q + np.linspace(0.0, 1.0, 30)[:, None] * turn


def places(q):
    return (ur5e.forward(q) @ rg2.T_FLANGE_TCP)[:, :3, 3]


@given(turns, turns, radii)
def test_a_corner_is_left_within_its_radius_only_and_its_ends_are_met(first, second, radius):
    legs = [leg(START, first), leg(START + first, second)]
    path = round_corners(legs, [radius, 0.0], rg2.T_FLANGE_TCP, 15)
    np.testing.assert_array_equal(path.q[0], START)
    np.testing.assert_array_equal(path.q[-1], legs[-1][-1])
    assert (np.diff(path.leg) >= 0).all()
    corner = places(legs[0][-1:])[0]
    on_legs = path.leg == path.other
    for k in (0, 1):
        # Outside the corner the samples are those of the legs.
        own = path.q[on_legs & (path.leg == k)]
        assert all(np.abs(legs[k] - q).max(axis=1).min() < 1e-12 for q in own)
    off = np.linalg.norm(places(path.q[~on_legs]) - corner, axis=1)
    # The curve bulges by less than a tenth: joints turn the tool on arcs.
    assert (off < 1.1 * radius + 1e-6).all()


@given(turns, turns, radii)
def test_a_corner_has_no_kink(first, second, radius):
    legs = [leg(START, first), leg(START + first, second)]
    path = round_corners(legs, [radius, 0.0], rg2.T_FLANGE_TCP, 200)
    inside = path.q[path.leg != path.other]
    if len(inside) < 3 or min(np.abs(first).max(), np.abs(second).max()) < 0.05:
        return
    start, end = inside[1] - inside[0], inside[-1] - inside[-2]
    for chord, turn in ((start, first), (end, second)):
        if np.linalg.norm(chord) > 1e-9:
            assert chord @ turn / np.linalg.norm(chord) / np.linalg.norm(turn) > 0.9


def test_without_a_radius_the_corner_is_met():
    first, second = np.array([0.3, 0, 0, 0, 0, 0]), np.array([0, 0.2, 0, 0, 0, 0])
    path = round_corners([leg(START, first), leg(START + first, second)], [0.0, 0.0], rg2.T_FLANGE_TCP, 9)
    assert (path.leg == path.other).all()
    assert np.abs(path.q - (START + first)).max(axis=1).min() == 0


@pytest.mark.parametrize("radius", [0.2, 1.0])
def test_two_corners_of_one_leg_never_meet(radius):
    ways = np.eye(6)[:3] * 0.2
    ends = START + np.cumsum(ways, axis=0)
    legs = [leg(START, ways[0]), leg(ends[0], ways[1]), leg(ends[1], ways[2])]
    path = round_corners(legs, [radius, radius, 0.0], rg2.T_FLANGE_TCP, 9)
    middle = ends[0] + ways[1] / 2
    assert np.abs(path.q - middle).max(axis=1).min() < 1e-9
    assert (np.diff(path.leg) >= 0).all()
