"""What every `Arm` does."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.errors import ConnectionLost, DeviceFault, UnsafeMotion
from robotcell.findings import Grade
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import make_transform, rotation_angle, rotation_z
from robotcell.interfaces import KICK_TIMEOUT_S, ArmMode, JointWaypoint, LinearWaypoint

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.cell import Cell
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import ArmState, Waypoint
    from tests.contract.conftest import Opened

PERIOD_S = 0.008


def test_connects_once_and_closes_twice(closed_cell: Cell) -> None:
    arm = closed_cell.arm
    arm.close()
    with arm as entered:
        assert entered is arm
        arm.connect()
        assert arm.state().mode is ArmMode.READY
    arm.close()
    with pytest.raises(ConnectionLost):
        arm.state()


@pytest.mark.parametrize(
    "call",
    ["state", "report", "stop", "kick", "recover", "moving", "start_joints", "start_linear", "start_path"],
)
def test_refuses_everything_before_it_is_connected(closed_cell: Cell, call: str) -> None:
    arm = closed_cell.arm
    calls: dict[str, Callable[[], object]] = {
        "state": arm.state,
        "report": arm.report,
        "stop": arm.stop,
        "kick": arm.kick,
        "recover": arm.recover,
        "moving": lambda: arm.moving,
        "start_joints": lambda: arm.start_joints(np.zeros(6), 0.1, 0.1),
        "start_linear": lambda: arm.start_linear(np.eye(4), 0.1, 0.1),
        "start_path": lambda: arm.start_path([JointWaypoint(np.zeros(6), 0.1, 0.1)]),
    }
    with pytest.raises(ConnectionLost):
        calls[call]()


def test_state_is_one_consistent_measurement(cell: Cell) -> None:
    state = cell.arm.state()
    assert state.q.shape == state.qd.shape == state.wrench.shape == (6,)
    assert np.isfinite(state.wrench).all()
    assert state.t <= cell.clock.now()
    tip = make_transform(np.eye(3), (0, 0, rg2.CLOSED_LENGTH_M))
    # A real arm's own calibration differs from the nominal one by some millimetres.
    assert np.abs(state.T_base_tcp - ur5e.forward(state.q) @ tip).max() < 0.01
    np.testing.assert_allclose(state.q, cell.config.motion.home_q, atol=0.01)


def test_a_connected_arm_reports_nothing_that_keeps_it_from_a_job(cell: Cell) -> None:
    assert [finding for finding in cell.arm.report() if finding.grade is Grade.WRONG] == []


def test_joint_motion_returns_at_once_and_arrives(cell: Cell, pace: float) -> None:
    target = cell.arm.state().q + np.array((0.2, -0.1, 0.1, 0.0, 0.1, -0.3))
    begin = cell.clock.now()
    cell.arm.start_joints(target, 1.0 * pace, 1.4 * pace**2)
    assert cell.arm.moving
    finish(cell)
    # 0.3 rad with ramps of 1.4 rad/s^2 never reach 1 rad/s: 2 sqrt(0.3 / 1.4) s.
    # In real time a busy machine may hold the motion up, and never hurries it.
    lasts_s = 2 * np.sqrt(0.3 / 1.4) / pace
    assert lasts_s - 0.1 < cell.clock.now() - begin < lasts_s + 1.0
    np.testing.assert_allclose(cell.arm.state().q, target, atol=2e-3)
    np.testing.assert_allclose(cell.arm.state().qd, 0, atol=0.02)


def test_joint_motion_to_where_it_is_ends_at_once(cell: Cell, pace: float) -> None:
    q = cell.arm.state().q
    cell.arm.start_joints(q, 1.0 * pace, 1.4 * pace**2)
    finish(cell)
    np.testing.assert_allclose(cell.arm.state().q, q, atol=1e-3)


def test_linear_motion_keeps_to_the_line_and_its_speed(cell: Cell, pace: float) -> None:
    T_start = cell.arm.state().T_base_tcp
    T_end = T_start.copy()
    T_end[:3, 3] += (0.05, -0.04, 0.06)
    T_end[:3, :3] = rotation_z(0.3) @ T_end[:3, :3]
    along = T_end[:3, 3] - T_start[:3, 3]
    length = np.linalg.norm(along)
    cell.arm.start_linear(T_end, 0.1 * pace, 0.5 * pace**2)
    states = [cell.arm.state()]
    while cell.arm.moving:
        cell.arm.kick()
        cell.clock.sleep(PERIOD_S)
        state = cell.arm.state()
        # A state may be read twice.
        if state.t > states[-1].t + PERIOD_S / 2:
            states.append(state)
    steps = np.array([state.T_base_tcp[:3, 3] for state in states]) - T_start[:3, 3]
    times = np.array([state.t for state in states])
    assert np.linalg.norm(np.cross(steps, along / length), axis=1).max() < 0.001
    # Over some time: a device measures less often than it reports, and a served arm that was late catches up.
    later = np.searchsorted(times, times + 0.4)
    whole = later < len(times)
    ways = np.linalg.norm(steps[later[whole]] - steps[whole], axis=1)
    assert (ways / (times[later[whole]] - times[whole])).max() < 0.1 * pace * 1.3
    T_reached = cell.arm.state().T_base_tcp
    assert np.abs(T_reached[:3, 3] - T_end[:3, 3]).max() < 0.001
    assert rotation_angle(T_reached[:3, :3], T_end[:3, :3]) < 0.005


def test_stop_ends_a_motion_short_of_its_target(cell: Cell, pace: float) -> None:
    start = cell.arm.state().q
    cell.arm.start_joints(start + np.array((0.3, 0, 0, 0, 0, 0)), 0.5 * pace, 1.4 * pace**2)
    run(cell, 0.5 / pace)
    cell.arm.stop()
    at_stop = cell.arm.state().q[0]
    finish(cell)
    run(cell, 0.2)
    state = cell.arm.state()
    assert state.mode is ArmMode.READY
    assert start[0] + 0.05 < state.q[0] < start[0] + 0.27
    # 0.5 rad/s is braked within less than a tenth of a second.
    assert state.q[0] - at_stop < 0.05
    np.testing.assert_allclose(state.qd, 0, atol=0.02)
    cell.arm.stop()


def around_a_corner(cell: Cell, pace: float) -> tuple[list[Waypoint], Array]:
    """A joint motion, a straight one and a joint motion, blended; and where the first corner is, base frame [m]."""
    q = cell.arm.state().q
    first, last = q + np.array((0.15, 0, 0, 0, 0, 0.2)), q + np.array((-0.15, 0.1, 0, 0, 0, 0))
    tip = make_transform(np.eye(3), (0, 0, rg2.CLOSED_LENGTH_M))
    corner = ur5e.forward(first) @ tip
    down = corner.copy()
    down[2, 3] -= 0.08
    joint_pace = (0.8 * pace, 1.4 * pace**2)
    return [
        JointWaypoint(first, *joint_pace, blend_m=0.03),
        LinearWaypoint(down, 0.2 * pace, 1.0 * pace**2, blend_m=0.03),
        JointWaypoint(last, *joint_pace),
    ], corner[:3, 3]


def test_a_path_passes_its_corners_in_order_without_a_halt_and_ends_at_rest(cell: Cell, pace: float) -> None:
    path, corner = around_a_corner(cell, pace)
    cell.arm.start_path(path)
    assert cell.arm.moving
    states = followed(cell)
    tcp = np.array([state.T_base_tcp[:3, 3] for state in states])
    targets = (corner, corner - (0, 0, 0.08))
    nearest = [int(np.linalg.norm(tcp - target, axis=1).argmin()) for target in targets]
    assert 0 < nearest[0] < nearest[1] < len(states) - 1
    for at, target in zip(nearest, targets, strict=True):
        # Rounded: within the radius (and what a state may lag), and at speed.
        assert 0.001 < np.linalg.norm(tcp[at] - target) < 0.03 + 0.005
        assert np.abs(states[at].qd).max() > 0.03 * pace
    state = cell.arm.state()
    assert isinstance(path[-1], JointWaypoint)
    np.testing.assert_allclose(state.q, path[-1].q, atol=2e-3)
    np.testing.assert_allclose(state.qd, 0, atol=0.02)
    assert state.mode is ArmMode.READY


def test_a_path_follows_a_path(cell: Cell, pace: float) -> None:
    q = cell.arm.state().q
    for shift in (0.1, 0.05, 0.0):
        target = q + np.array((shift, 0, 0, 0, 0, 0))
        between = JointWaypoint(target + np.array((0, 0.05, 0, 0, 0, 0)), 0.5 * pace, pace**2, 0.01)
        cell.arm.start_path([between, JointWaypoint(target, 0.5 * pace, pace**2)])
        finish(cell)
        np.testing.assert_allclose(cell.arm.state().q, target, atol=2e-3)


def test_a_stop_in_the_middle_of_a_corner_ends_a_path_there(cell: Cell, pace: float) -> None:
    path, corner = around_a_corner(cell, pace)
    cell.arm.start_path(path)
    while np.linalg.norm(cell.arm.state().T_base_tcp[:3, 3] - corner) > 0.02:
        assert cell.arm.moving
        run(cell, PERIOD_S)
    cell.arm.stop()
    at_stop = cell.arm.state()
    finish(cell)
    run(cell, 0.2)
    state = cell.arm.state()
    assert state.mode is ArmMode.READY
    assert np.abs(state.q - at_stop.q).max() < 0.1
    assert np.linalg.norm(state.T_base_tcp[:3, 3] - corner) < 0.06
    np.testing.assert_allclose(state.qd, 0, atol=0.02)
    # The next motion starts from there.
    cell.arm.start_path(path[-1:])
    finish(cell)
    assert isinstance(path[-1], JointWaypoint)
    np.testing.assert_allclose(cell.arm.state().q, path[-1].q, atol=2e-3)


def test_a_path_that_nobody_kicks_stops(cell: Cell, pace: float) -> None:
    path, _ = around_a_corner(cell, pace)
    cell.arm.start_path(path)
    cell.clock.sleep(KICK_TIMEOUT_S + 0.5)
    stopped = cell.arm.state()
    assert not cell.arm.moving
    assert isinstance(path[-1], JointWaypoint)
    assert np.abs(stopped.q - path[-1].q).max() > 0.05
    cell.clock.sleep(0.3)
    np.testing.assert_allclose(cell.arm.state().q, stopped.q, atol=2e-3)


def test_refuses_paths_that_are_none(cell: Cell, pace: float) -> None:
    path, _ = around_a_corner(cell, pace)
    for wrong in (
        [],
        [*path[:1], replace(path[1], blend_m=-0.01), path[2]],
        [replace(path[0], blend_m=float("nan"))],
        path[:1],
    ):
        with pytest.raises(UnsafeMotion):
            cell.arm.start_path(wrong)
    assert not cell.arm.moving


def test_a_second_motion_waits_for_the_first(cell: Cell, pace: float) -> None:
    q = cell.arm.state().q
    cell.arm.start_joints(q + 0.05, 0.5 * pace, pace**2)
    with pytest.raises(UnsafeMotion, match="moving"):
        cell.arm.start_joints(q, 0.5 * pace, pace**2)
    finish(cell)
    np.testing.assert_allclose(cell.arm.state().q, q + 0.05, atol=2e-3)


def test_the_watchdog_stops_an_arm_whose_supervisor_fell_silent(cell: Cell, pace: float) -> None:
    q = cell.arm.state().q
    cell.arm.start_joints(q + np.array((0.3, 0, 0, 0, 0, 0)), 0.5 * pace, 1.4 * pace**2)
    for _ in range(20):
        cell.arm.kick()
        cell.clock.sleep(PERIOD_S)
    assert cell.arm.moving
    cell.clock.sleep(0.5)
    assert not cell.arm.moving
    assert cell.arm.state().q[0] < q[0] + 0.25


def test_a_motion_that_nobody_ever_kicks_stops(closed_cell: Cell, pace: float) -> None:
    with closed_cell.arm as arm, closed_cell.gripper:
        start = arm.state().q[0]
        begin = closed_cell.clock.now()
        arm.start_joints(arm.state().q + np.array((0.3, 0, 0, 0, 0, 0)), 0.5 * pace, 1.4 * pace**2)
        while arm.moving and closed_cell.clock.now() - begin < 2.0:
            closed_cell.clock.sleep(PERIOD_S)
        # The motion takes 0.96 s. In real time a busy machine notices the silence, and the standstill, late.
        assert KICK_TIMEOUT_S < closed_cell.clock.now() - begin < KICK_TIMEOUT_S + 0.5
        assert not arm.moving
        turned = arm.state().q[0] - start
        assert turned < 0.2
        assert arm.state().mode is ArmMode.READY
        arm.start_joints(arm.state().q - np.array((turned, 0, 0, 0, 0, 0)), 0.5 * pace, 1.4 * pace**2)
        finish(closed_cell)
        assert arm.state().q[0] == pytest.approx(start, abs=2e-3)


BAD_JOINTS = [np.zeros(5), np.full(6, np.nan), np.array([7.0, 0, 0, 0, 0, 0]), np.array([0, 0, 3.2, 0, 0, 0])]


@pytest.mark.parametrize("q", BAD_JOINTS)
def test_refuses_joint_targets_that_it_does_not_have(cell: Cell, pace: float, q: Array) -> None:
    with pytest.raises(UnsafeMotion):
        cell.arm.start_joints(q, 0.5 * pace, pace**2)
    assert not cell.arm.moving


@pytest.mark.parametrize("value", [0.0, -0.1, 1000.0, np.nan, np.inf])
def test_refuses_speeds_and_accelerations_outside_its_range(cell: Cell, value: float) -> None:
    state = cell.arm.state()
    for speed, acceleration in ((value, 0.5), (0.5, value)):
        with pytest.raises(UnsafeMotion):
            cell.arm.start_joints(state.q + 0.01, speed, acceleration)
        with pytest.raises(UnsafeMotion):
            cell.arm.start_linear(state.T_base_tcp, speed, acceleration)
    assert not cell.arm.moving


def test_refuses_poses_that_are_none(cell: Cell, pace: float) -> None:
    T = cell.arm.state().T_base_tcp
    mirrored = T @ np.diag([1.0, 1.0, -1.0, 1.0])
    for pose in (mirrored, T[:3], np.full((4, 4), np.nan)):
        with pytest.raises(UnsafeMotion):
            cell.arm.start_linear(pose, 0.1 * pace, 0.5 * pace**2)
    assert not cell.arm.moving


def test_a_line_out_of_reach_leaves_an_arm_that_must_be_recovered(closed_cell: Cell, opened: Opened) -> None:
    if opened.real:
        pytest.skip("a real arm is not sent to the end of its reach")
    with closed_cell.arm as arm, closed_cell.gripper:
        far = arm.state().T_base_tcp.copy()
        far[:3, 3] = (-2.0, 0.0, 0.3)
        arm.start_linear(far, 0.5, 1.0)
        finish(closed_cell)
        assert arm.state().mode is not ArmMode.READY
        with pytest.raises(DeviceFault):
            arm.start_linear(far, 0.5, 1.0)
        arm.recover()
        assert arm.state().mode is ArmMode.READY


def test_recover_does_nothing_to_an_arm_that_is_ready(cell: Cell) -> None:
    cell.arm.recover()
    assert cell.arm.state().mode is ArmMode.READY


def run(cell: Cell, seconds: float) -> None:
    for _ in range(round(seconds / PERIOD_S)):
        cell.arm.kick()
        cell.clock.sleep(PERIOD_S)


def finish(cell: Cell) -> None:
    while cell.arm.moving:
        cell.arm.kick()
        cell.clock.sleep(PERIOD_S)


def followed(cell: Cell) -> list[ArmState]:
    """The states of a supervised motion until its end."""
    states = [cell.arm.state()]
    while cell.arm.moving:
        run(cell, PERIOD_S)
        states.append(cell.arm.state())
    return states
