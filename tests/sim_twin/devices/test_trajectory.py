import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_twin.devices.trajectory import slow_down, trapezoid

PERIOD = 1 / 240

lengths = st.floats(1e-4, 3.0)
speeds = st.floats(0.02, 3.0)
accelerations = st.floats(0.05, 40.0)


@given(lengths, speeds, accelerations)
def test_a_profile_arrives_and_keeps_to_its_limits(distance, speed, acceleration):
    s = np.concatenate([[0.0, 0.0], trapezoid(distance, speed, acceleration, PERIOD)])
    assert s[-1] == distance
    s = np.append(s, distance)
    rates = np.diff(s) / PERIOD
    assert (rates >= -1e-9).all()
    assert rates.max() <= speed * (1 + 1e-9)
    assert np.abs(np.diff(rates)).max() / PERIOD <= acceleration * (1 + 1e-6) + 1e-6


@given(lengths, speeds, accelerations)
def test_a_profile_takes_no_longer_than_it_must(distance, speed, acceleration):
    n = len(trapezoid(distance, speed, acceleration, PERIOD))
    ramp_way = speed**2 / acceleration
    best = distance / speed + speed / acceleration if distance > ramp_way else 2 * np.sqrt(distance / acceleration)
    assert best - 1e-9 <= n * PERIOD <= best + PERIOD * (1 + 1e-6)


def test_no_way_needs_no_time():
    assert len(trapezoid(0.0, 1.0, 1.0, PERIOD)) == 0


@given(lengths, speeds, accelerations, st.floats(1.0, 30.0), st.floats(0, 1))
def test_braking_keeps_to_the_path_and_never_turns_back(distance, speed, acceleration, deceleration, when):
    s = trapezoid(distance, speed, acceleration, PERIOD)
    path = np.concatenate([[0.0], s])[:, None] * np.array([1.0, -0.5, 0.0])
    index = int(when * (len(path) - 1))
    rest = slow_down(path, index, deceleration, PERIOD)
    travelled = np.concatenate([[path[index, 0]], rest[:, 0]])
    np.testing.assert_allclose(rest[:, 1], -0.5 * rest[:, 0], atol=1e-12)
    assert (np.diff(travelled) >= -1e-12).all()
    assert (travelled <= distance).all()
    # Braking at speed v takes v^2 / 2a, or less where the path was ending anyway.
    v = (path[index + 1, 0] - path[index, 0]) / PERIOD if index + 1 < len(path) else 0.0
    gained = acceleration * (v / deceleration + PERIOD) ** 2
    assert travelled[-1] - travelled[0] <= v**2 / (2 * deceleration) + gained + 1e-9


def test_braking_at_constant_speed_takes_the_distance_of_physics():
    path = np.arange(1000)[:, None] * PERIOD * 1.0
    rest = slow_down(path, 100, 10.0, PERIOD)
    assert rest[-1, 0] - path[100, 0] == pytest.approx(1.0**2 / 20, abs=1e-3)
    rates = np.diff(np.concatenate([path[100:101], rest]), axis=0)[:, 0] / PERIOD
    assert np.abs(np.diff(rates)).max() / PERIOD <= 10.0 * 1.01


def test_braking_at_the_end_of_a_path_needs_nothing():
    path = np.arange(5.0)[:, None]
    assert slow_down(path, 4, 10.0, PERIOD).shape == (0, 1)
