import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import JointWaypoint, LinearWaypoint
from sim_twin.devices.motion import plan_motion
from sim_twin.devices.trajectory import MAX_JOINT_JERK_RAD_S3, slow_down, trapezoid

PERIOD = 1 / 240

lengths = st.floats(1e-4, 3.0)
speeds = st.floats(0.02, 3.0)
accelerations = st.floats(0.05, 40.0)
turns = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6).map(np.array)


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


START = np.array([-0.8370, -1.4768, 1.2793, -1.3733, -1.5708, 0.7338])
TOOL = rg2.T_FLANGE_TCP


def driven(waypoints):
    """Joint angles of a motion, at rest before and after, and the speeds, accelerations and jerks of the joints."""
    motion = plan_motion(START, waypoints, TOOL, PERIOD)
    assert not motion.breaks_off
    end = motion.q[-1:] if len(motion.q) else START[None]
    q = np.vstack([np.repeat(START[None], 3, axis=0), motion.q, np.repeat(end, 3, axis=0)])
    rates = [q]
    for _ in range(3):
        rates.append(np.diff(rates[-1], axis=0) / PERIOD)
    return motion, rates


@given(turns, turns, st.floats(0.3, 3.0), st.floats(0.5, 7.0), st.floats(0.0, 0.1))
@settings(max_examples=30)
def test_blended_joint_motions_keep_speed_acceleration_and_jerk(first, second, speed, acceleration, blend):
    way = (
        JointWaypoint(START + first, speed, acceleration, blend),
        JointWaypoint(START + first + second, speed, acceleration),
    )
    motion, (q, v, a, j) = driven(way)
    np.testing.assert_allclose(q[-1], way[-1].q, atol=1e-8)
    assert np.abs(v).max() <= 1.01 * speed
    # Where a corner begins the curvature jumps, and a sample falls on either side.
    assert np.abs(a).max() <= 1.10 * acceleration
    assert np.abs(j).max() <= 1.05 * MAX_JOINT_JERK_RAD_S3
    assert (np.diff(motion.leg) >= 0).all()


def test_a_blend_saves_time_and_a_halt_costs_it():
    above = START + np.array((0.6, 0, 0, 0, 0, 0.4))
    down = ur5e.forward(above) @ TOOL
    down[2, 3] -= 0.15
    lasts = []
    for blend in (0.0, 0.02, 0.05):
        motion = plan_motion(
            START,
            (JointWaypoint(above, 1.5, 1.4, blend), LinearWaypoint(down, 0.4, 1.2)),
            TOOL,
            PERIOD,
        )
        lasts.append(len(motion.q))
        np.testing.assert_allclose(ur5e.forward(motion.q[-1]) @ TOOL, down, atol=1e-6)
    assert lasts[0] > lasts[1] > lasts[2]


def test_the_tool_keeps_the_limits_of_a_line():
    goal = ur5e.forward(START) @ TOOL
    goal[:3, 3] += (0.1, -0.1, -0.1)
    motion, _ = driven((LinearWaypoint(goal, 0.4, 1.2),))
    tcp = (ur5e.forward(np.vstack([[START] * 2, motion.q, [motion.q[-1]] * 2])) @ TOOL)[:, :3, 3]
    v = np.diff(tcp, axis=0) / PERIOD
    assert np.linalg.norm(v, axis=1).max() <= 0.4 * 1.005
    assert np.linalg.norm(np.diff(v, axis=0), axis=1).max() / PERIOD <= 1.2 * 1.03
