"""The motions of the served controller, period by period."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.geometry import ur5e
from robotcell.geometry.transforms import invert_transform, matrix_to_rotvec, rotvec_to_matrix
from sim_twin.devices.trajectory import MAX_JOINT_JERK_RAD_S3
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.arm import Arm
from sim_twin.wire.ur.force_mode import ForceMode
from sim_twin.wire.ur.moves import Move, follow
from sim_twin.wire.ur.pose import matrix_to_pose, pose_to_matrix
from sim_twin.wire.ur.program import ScriptError, Thread
from sim_twin.wire.ur.speed_servo import servo_circular, servo_joints, speed_joints, speed_line
from sim_twin.wire.ur.stops import stop_joints, stop_line
from tests.sim_twin.wire.ur.stub_world import START_Q

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

START = np.array(START_Q)
TOOL = (0.0, 0.0, 0.2, 0.0, 0.0, 0.0)


def run(arm: Arm, motion: Thread, periods: int = 100_000) -> Array:
    """The targets of a motion; the joints follow at once."""
    targets = [arm.q]
    for _ in range(periods):
        try:
            next(motion)
        except StopIteration:
            break
        arm.finish_period()
        arm.measure(arm.q.copy(), arm.qd.copy(), np.zeros(6))
        targets.append(arm.q)
    return np.array(targets)


def coast(arm: Arm) -> Array:
    """The targets of an arm that nobody moves any more."""
    targets = [arm.q]
    while arm.momentum.any():
        arm.finish_period()
        targets.append(arm.q)
    return np.array(targets)


def stands(arm: Arm) -> bool:
    """Whether the arm stands still in the next period."""
    arm.finish_period()
    return arm.steady


def speeds(targets: Array) -> Array:
    return np.abs(np.diff(targets, axis=0)).max(axis=1) / PERIOD_S


def joints(q: Array, speed: float = 1.0, acceleration: float = 2.0, blend: float = 0.0) -> Move:
    return Move(tuple(q.tolist()), False, False, speed, acceleration, blend)


def line(T: Array, speed: float = 0.25, acceleration: float = 1.2, blend: float = 0.0) -> Move:
    return Move(matrix_to_pose(T), True, True, speed, acceleration, blend)


@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).filter(lambda v: 1e-6 < np.linalg.norm(v) <= 1))
def test_a_pose_is_that_of_its_matrix(axis: list[float]) -> None:
    pose = (0.1, -0.2, 0.3, *np.pi * np.array(axis))
    np.testing.assert_allclose(matrix_to_pose(pose_to_matrix(pose)), pose, atol=1e-7)


def test_the_pose_is_that_of_the_tcp() -> None:
    arm = Arm(START)
    np.testing.assert_allclose(arm.forward(START), ur5e.forward(START), atol=1e-9)
    arm.set_tcp(TOOL)
    tip = ur5e.forward(START) @ [0, 0, 0.2, 1]
    np.testing.assert_allclose(arm.forward(START)[:3, 3], tip[:3], atol=1e-9)
    np.testing.assert_allclose(arm.inverse(arm.forward(START), START + 0.01), START, atol=1e-6)


def test_joints_move_together_within_speed_and_acceleration() -> None:
    arm = Arm(START)
    goal = START + np.array([0.5, -0.2, 0.1, 0, 0, 0.3])
    path = run(arm, follow(arm, [joints(goal)]))
    np.testing.assert_allclose(path[-1], goal, atol=1e-12)
    assert speeds(path).max() <= 1.0 + 1e-6
    acceleration = np.diff(path, n=2, axis=0) / PERIOD_S**2
    assert np.abs(acceleration).max() <= 2.0 + 1e-4
    assert np.abs(np.diff(acceleration, axis=0)).max() / PERIOD_S <= MAX_JOINT_JERK_RAD_S3
    share = (path - START) / (goal - START + (goal == START))
    np.testing.assert_allclose(share[:, 0], share[:, 5], atol=1e-9)
    # The time of the ramps and of the rest, of the smoothing and of the planning.
    smoothing = 2 * 2.0 / MAX_JOINT_JERK_RAD_S3
    assert (len(path) - 1) * PERIOD_S == pytest.approx(0.5 / 1.0 + 1.0 / 2.0 + smoothing, abs=0.01)
    assert stands(arm)


def test_a_straight_move_stays_on_its_line() -> None:
    arm = Arm(START)
    arm.set_tcp(TOOL)
    T = arm.forward(START)
    goal = T.copy()
    goal[:3, 3] += [0.05, 0.1, -0.1]
    goal[:3, :3] = rotvec_to_matrix([0, 0, 0.4]) @ T[:3, :3]
    path = run(arm, follow(arm, [line(goal)]))
    np.testing.assert_allclose(arm.forward(path[-1]), goal, atol=1e-9)
    poses = np.array([arm.forward(q) for q in path])
    way = poses[:, :3, 3] - T[:3, 3]
    direction = (goal - T)[:3, 3] / np.linalg.norm((goal - T)[:3, 3])
    assert np.abs(way - np.outer(way @ direction, direction)).max() < 2e-5
    assert np.abs(np.diff(way @ direction)).max() / PERIOD_S <= 0.25 + 1e-4
    turns = [matrix_to_rotvec(pose[:3, :3] @ T[:3, :3].T)[2] for pose in poses]
    np.testing.assert_allclose(np.array(turns) / 0.4, way @ direction / 0.15, atol=1e-4)


@pytest.mark.parametrize("kinds", [(False, False), (True, True), (False, True), (True, False)])
def test_a_blend_cuts_the_corner_within_its_radius(kinds: tuple[bool, bool]) -> None:
    arm = Arm(START)
    T = arm.forward(START)
    corner, goal = T.copy(), T.copy()
    corner[:3, 3] += [0, 0, -0.15]
    goal[:3, 3] += [0, 0.15, -0.15]
    moves = [
        line(T, blend=blend) if straight else joints(arm.inverse(T, START), blend=blend)
        for T, straight, blend in zip((corner, goal), kinds, (0.03, 0.0), strict=True)
    ]
    places = np.array([arm.forward(q)[:3, 3] for q in run(arm, follow(arm, moves))])
    np.testing.assert_allclose(places[-1], goal[:3, 3], atol=1e-6)
    nearest = np.linalg.norm(places - corner[:3, 3], axis=1).min()
    assert 0.001 < nearest < 0.03
    # Without a blend the arm comes to a standstill in the corner itself.
    other = Arm(START)
    exact = [Move(m.target, m.is_pose, m.straight, m.speed, m.acceleration) for m in moves]
    unblended = np.array([other.forward(q)[:3, 3] for q in run(other, follow(other, exact))])
    assert np.linalg.norm(unblended - corner[:3, 3], axis=1).min() < 1e-6
    assert len(places) < len(unblended)


def test_the_numbers_of_the_way_points_are_told() -> None:
    arm = Arm(START)
    moves = [Move(tuple(START + 0.1 * i), False, False, 1.0, 5.0, 0.0, number=i) for i in (1, 2, 3)]
    told: list[int] = []
    run(arm, follow(arm, moves, told.append))
    assert told == [1, 2, 3]


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_the_slider_slows_a_motion_on_the_same_path(rate: float) -> None:
    full, slow = Arm(START), Arm(START)
    slow.rate = rate
    move = joints(START + np.array([0.2, 0, 0, 0, 0, 0]))
    path, slow_path = run(full, follow(full, [move])), run(slow, follow(slow, [move]))
    np.testing.assert_array_equal(slow_path[-1], path[-1])
    assert len(slow_path) - 1 == pytest.approx((len(path) - 1) / rate, abs=2 / rate)
    assert speeds(slow_path).max() <= rate * 1.0 + 1e-9


def test_an_arm_that_is_left_in_motion_brakes() -> None:
    arm = Arm(START)
    run(arm, follow(arm, [joints(START + 1.0, speed=1.5, acceleration=10)]), periods=200)
    speed = np.abs(arm.momentum).max()
    assert speed == pytest.approx(1.5)
    path = coast(arm)
    assert (len(path) - 1) * PERIOD_S == pytest.approx(1.5 / 20, abs=2 * PERIOD_S)
    assert np.abs(path[-1] - path[0]).max() == pytest.approx(1.5**2 / 2 / 20, abs=1.5 * PERIOD_S)
    assert stands(arm)


def test_stopj_brakes_as_it_is_told() -> None:
    arm = Arm(START)
    run(arm, speed_joints(arm, np.array([1.0, 0, 0.5, 0, 0, 0]), 10.0, 0.5))
    path = run(arm, stop_joints(arm, 4.0))
    assert (len(path) - 1) * PERIOD_S == pytest.approx(1.0 / 4.0, abs=2 * PERIOD_S)
    way = path[-1] - path[0]
    np.testing.assert_allclose(way / way[0], [1, 0, 0.5, 0, 0, 0], atol=1e-6)
    assert stands(arm)


def test_stopl_brakes_on_the_line() -> None:
    arm = Arm(START)
    run(arm, speed_line(arm, np.array([0, 0.2, -0.1, 0, 0, 0]), 1.0, 0.5))
    path = run(arm, stop_line(arm, 2.0))
    places = np.array([arm.forward(q)[:3, 3] for q in path])
    way = places[-1] - places[0]
    assert np.linalg.norm(way) == pytest.approx((0.2**2 + 0.1**2) / 2 / 2.0, rel=0.02)
    np.testing.assert_allclose(way / way[1], [0, 1, -0.5], atol=1e-3)
    assert stands(arm)


def test_speedl_reaches_its_speed_at_its_acceleration() -> None:
    arm = Arm(START)
    path = run(arm, speed_line(arm, np.array([0, 0, -0.1, 0, 0, 0.2]), 0.5, 0.6))
    assert len(path) - 1 == 300
    np.testing.assert_allclose(arm.twist(arm.q, arm.qd), [0, 0, -0.1, 0, 0, 0.2], atol=1e-3)
    heights = np.array([arm.forward(q)[2, 3] for q in path])
    assert np.abs(np.diff(heights, n=2)).max() / PERIOD_S**2 <= 0.5 + 1e-3


def test_servoj_chases_its_target_without_overshoot() -> None:
    arm = Arm(START)
    goal = START + np.array([0.1, 0, 0, 0, 0, -0.1])
    path = run(arm, servo_joints(arm, goal, 1.0, 0.1, 300))
    assert np.abs(path[-1] - goal).max() < 1e-5
    assert path[:, 0].max() <= goal[0] + 1e-9
    assert speeds(path).max() <= ur5e.MAX_JOINT_SPEED


def test_servoc_comes_to_its_pose() -> None:
    arm = Arm(START)
    goal = arm.forward(START)
    goal[:3, 3] += [0, 0.05, 0.05]
    path = run(arm, servo_circular(arm, matrix_to_pose(goal), 0.1, 0.5))
    np.testing.assert_allclose(arm.forward(path[-1]), goal, atol=1e-6)


@pytest.mark.parametrize(
    "move",
    [
        Move((3.0, 0, 0, 0, 0, 0), True, True, 0.1, 1.0),
        Move((7.0, 0, 0, 0, 0, 0), False, False, 0.1, 1.0),
        Move((float("nan"), 0, 0, 0, 0, 0), False, False, 0.1, 1.0),
        Move(START_Q, False, False, 0.0, 1.0),
        Move(START_Q, False, False, 1.0, -1.0),
    ],
)
def test_what_cannot_be_reached_kills_the_script_before_anything_moves(move: Move) -> None:
    arm = Arm(START)
    with pytest.raises(ScriptError):
        run(arm, follow(arm, [move]))
    np.testing.assert_array_equal(arm.q, START)


def test_a_line_through_a_singularity_kills_the_script_on_the_way() -> None:
    # The arm nearly stretched out upwards; the line passes over the shoulder.
    arm = Arm(np.array([0.0, -1.2, 0.6, -1.0, -1.57, 0.0]))
    T = arm.forward(arm.q)
    goal = T.copy()
    goal[0, 3], goal[1, 3] = -T[0, 3], -T[1, 3]
    with pytest.raises(ScriptError, match=r"singularity|find a solution"):
        run(arm, follow(arm, [line(goal, speed=1.0, acceleration=5.0)]))
    coast(arm)
    assert stands(arm)


def test_two_motions_at_a_time_are_refused() -> None:
    arm = Arm(START)
    one = speed_joints(arm, np.full(6, 0.1), 1.0, 1.0)
    other = follow(arm, [joints(START + 0.1)])
    next(one)
    with pytest.raises(ScriptError, match="another thread"):
        list(other)


def test_a_motion_cannot_go_on_where_the_arm_no_longer_is() -> None:
    arm = Arm(START)
    motion = follow(arm, [joints(START + 0.5)])
    run(arm, motion, periods=100)
    arm.measure(START - 0.2, np.zeros(6), np.zeros(6))
    arm.hold()
    with pytest.raises(ScriptError, match="not where the motion was left"):
        run(arm, motion)


def test_freedrive_follows_the_joints() -> None:
    arm = Arm(START)
    arm.freedrive = True
    arm.measure(START + 0.1, np.zeros(6), np.zeros(6))
    arm.finish_period()
    np.testing.assert_array_equal(arm.q, START + 0.1)
    assert stands(arm)


def test_force_mode_gives_way_along_its_axes_only() -> None:
    arm = Arm(START)
    arm.force_mode = ForceMode(
        np.eye(3), np.array([0, 0, 1, 0, 0, 0]), np.array([0, 0, -10.0, 0, 0, 0]), np.full(6, 0.02), 1.0
    )
    T = arm.forward(START)
    for _ in range(250):
        arm.finish_period()
    way = arm.forward(arm.q)[:3, 3] - T[:3, 3]
    np.testing.assert_allclose(way, [0, 0, -0.01 * 0.5], atol=1e-6)
    # The surface pushes back with the force that was asked for: it stands still.
    arm.measure(arm.q, arm.qd, np.array([0, 0, 10.0, 0, 0, 0]))
    arm.finish_period()
    before = arm.q
    arm.finish_period()
    np.testing.assert_allclose(arm.q, before, atol=1e-12)


def test_the_wrench_is_about_the_tcp_and_can_be_zeroed() -> None:
    arm = Arm(START)
    arm.set_tcp(TOOL)
    force = np.array([3.0, -1.0, 2.0])
    lever = ur5e.forward(START)[:3, :3] @ [0, 0, 0.2]
    # A force through the tcp has no moment about it.
    wrench = np.concatenate([force, np.cross(lever, force)])
    arm.measure(START, np.zeros(6), wrench)
    np.testing.assert_allclose(arm.tcp_wrench, [*force, 0, 0, 0], atol=1e-9)
    arm.zero_wrench()
    arm.measure(START, np.zeros(6), 2 * wrench)
    np.testing.assert_allclose(arm.tcp_wrench, [*force, 0, 0, 0], atol=1e-9)


def test_the_frame_of_the_tcp_is_undone_in_inverse_kinematics() -> None:
    arm = Arm(START)
    tcp = (0.01, 0.02, 0.2, 0.1, -0.2, 0.3)
    arm.set_tcp(tcp)
    np.testing.assert_allclose(
        arm.forward(START) @ invert_transform(pose_to_matrix(tcp)), ur5e.forward(START), atol=1e-9
    )
