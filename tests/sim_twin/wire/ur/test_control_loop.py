"""Every command of ur_rtde's control loop, by its registers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.geometry import ur5e
from sim_twin.wire.ur.modes import RuntimeState, SafetyMode
from sim_twin.wire.ur.moves import Move
from sim_twin.wire.ur.pose import matrix_to_pose, pose_to_matrix
from sim_twin.wire.ur.snapshot import Snapshot
from sim_twin.wire.ur.variables import OUTPUTS
from tests.sim_twin.wire.ur.stepped_controller import SteppedControlLoop
from tests.sim_twin.wire.ur.stub_world import START_Q

START = np.array(START_Q)
GOAL = START + np.array([0.2, 0, 0, 0, 0, 0.1])
MOVE_J, MOVE_J_IK, MOVE_L, MOVE_L_FK = 1, 2, 3, 4
FORCE_MODE, FORCE_MODE_STOP, ZERO_FT = 6, 7, 8
SPEED_J, SPEED_L, SERVO_J, SERVO_C, SPEED_STOP, SERVO_STOP, SERVO_L = 9, 10, 11, 12, 15, 16, 24
STOP_L, STOP_J, WATCHDOG, PATH, STOP_SCRIPT = 33, 34, 35, 45, 255


@pytest.fixture
def stepped() -> SteppedControlLoop:
    return SteppedControlLoop()


def above(q: np.ndarray, dz: float) -> tuple[float, ...]:
    T = ur5e.forward(q)
    T[2, 3] += dz
    return matrix_to_pose(T)


@pytest.mark.parametrize("command", [MOVE_J, MOVE_L_FK])
def test_moves_to_joints_arrive(stepped: SteppedControlLoop, command: int) -> None:
    assert stepped.call(command, [*GOAL, 1.0, 2.0], [0])
    np.testing.assert_allclose(stepped.q, GOAL, atol=1e-6)


@pytest.mark.parametrize("command", [MOVE_J_IK, MOVE_L])
def test_moves_to_poses_arrive(stepped: SteppedControlLoop, command: int) -> None:
    pose = above(START, 0.05)
    assert stepped.call(command, [*pose, 0.5, 1.0], [0])
    np.testing.assert_allclose(ur5e.forward(stepped.q), pose_to_matrix(pose), atol=1e-6)


def test_an_asynchronous_move_returns_at_once_and_reports_its_end(stepped: SteppedControlLoop) -> None:
    before, running, _ = stepped.word()
    assert not running
    assert stepped.call(MOVE_J, [*GOAL, 1.0, 2.0], [1], limit=0.1)
    assert stepped.word() == (before + 1, True, 0)
    stepped.rest()
    assert stepped.word()[:2] == (before + 1, False)
    np.testing.assert_allclose(stepped.q, GOAL)


@pytest.mark.parametrize(("command", "asynchronous"), [(STOP_J, 0), (STOP_J, 1), (STOP_L, 0), (STOP_L, 1)])
def test_stops_end_an_asynchronous_move(stepped: SteppedControlLoop, command: int, asynchronous: int) -> None:
    assert stepped.call(MOVE_J, [*(START + 1.0), 1.0, 5.0], [1])
    stepped.seconds(0.3)
    assert stepped.call(command, [10.0], [asynchronous], limit=1.0)
    stepped.rest(0.5)
    assert not stepped.word()[1]
    assert stepped.running
    assert 0.1 < stepped.q[0] < 0.6
    # Nothing goes on behind it.
    assert stepped.call(MOVE_J, [*START, 1.0, 5.0], [0])


def test_a_path_tells_its_way_points(stepped: SteppedControlLoop) -> None:
    moves = [Move(tuple(START + 0.1 * i), False, False, 1.0, 5.0, 0.0, number=i) for i in (0, 1, 2)]
    stepped = SteppedControlLoop(moves[1:])
    assert stepped.call(PATH, ints=[0])
    np.testing.assert_allclose(stepped.q, START + 0.2)
    stepped = SteppedControlLoop(moves[1:])
    assert stepped.call(PATH, ints=[1], limit=0.1)
    seen = set()
    while stepped.word()[1]:
        seen.add(stepped.word()[2])
        stepped.tick()
    assert {1, 2} <= seen
    np.testing.assert_allclose(stepped.q, START + 0.2)


def test_registers_of_the_upper_range(stepped: SteppedControlLoop) -> None:
    stepped = SteppedControlLoop(offset=24)
    assert stepped.call(MOVE_J, [*GOAL, 1.0, 2.0], [0])
    np.testing.assert_allclose(stepped.q, GOAL)


@pytest.mark.parametrize("command", [SPEED_J, SPEED_L])
def test_speeds_go_on_until_they_are_stopped(stepped: SteppedControlLoop, command: int) -> None:
    stepped.set(command, [0, 0, 0.05, 0, 0, 0, 1.0, 0.004])
    stepped.seconds(0.5)
    # What the client clears in between does not stop the arm.
    stepped.set(0)
    stepped.seconds(0.5)
    assert not stepped.controller.arm.steady
    moving = (
        stepped.controller.arm.qd
        if command == SPEED_J
        else stepped.controller.arm.twist(stepped.q, stepped.controller.arm.qd)
    )
    assert moving[2] == pytest.approx(0.05, abs=1e-3)
    assert stepped.call(SPEED_STOP, [5.0])
    stepped.rest(0.1)


def test_servoj_follows_a_stream_of_targets(stepped: SteppedControlLoop) -> None:
    for i in range(300):
        stepped.set(SERVO_J, [*(START + 0.001 * i), 0, 0, 0.002, 0.03, 1000])
        stepped.tick()
    assert stepped.call(SERVO_STOP, [5.0])
    assert stepped.q[0] == pytest.approx(0.3, abs=0.05)
    stepped.rest(0.1)


@pytest.mark.parametrize("command", [SERVO_L, SERVO_C])
def test_servo_to_a_pose(stepped: SteppedControlLoop, command: int) -> None:
    pose = above(START, 0.03)
    stepped.set(command, [*pose, *((0.1, 0.5, 0.0) if command == SERVO_C else (0, 0, 0.002, 0.1, 300))])
    stepped.seconds(2.0)
    stepped.set(0)
    stepped.tick()
    assert stepped.call(SERVO_STOP, [5.0])
    np.testing.assert_allclose(ur5e.forward(stepped.q), pose_to_matrix(pose), atol=1e-4)


def test_tcp_and_payload_are_set_and_told(stepped: SteppedControlLoop) -> None:
    tcp = (0.01, 0.0, 0.2, 0.0, 0.1, 0.0)
    assert stepped.call(29, tcp)
    assert stepped.answer(40) == list(tcp)
    np.testing.assert_allclose(stepped.answer(43), matrix_to_pose(ur5e.forward(stepped.q) @ pose_to_matrix(tcp)))
    stepped.set(58)
    stepped.tick()
    flange = stepped.controller.registers.output_double[:6]
    np.testing.assert_allclose(flange, matrix_to_pose(ur5e.forward(stepped.q)))
    stepped.set(0)
    stepped.tick()
    assert stepped.call(17, [1.2, 0.01, 0.02, 0.03])
    assert (stepped.controller.payload.mass, stepped.controller.payload.cog) == (1.2, (0.01, 0.02, 0.03))
    assert stepped.call(17, [1.5, 0, 0, 0])
    assert (stepped.controller.payload.mass, stepped.controller.payload.cog) == (1.5, (0.01, 0.02, 0.03))
    assert stepped.call(65, [1.0, 0, 0, 0.05, *range(6)])
    assert stepped.controller.payload.inertia == (0, 1, 2, 3, 4, 5)
    assert not stepped.call(17, [-1.0, 0, 0, 0])


def test_kinematics_of_the_set_tcp(stepped: SteppedControlLoop) -> None:
    assert stepped.call(29, [0, 0, 0.2, 0, 0, 0])
    pose = matrix_to_pose(ur5e.forward(GOAL) @ pose_to_matrix((0, 0, 0.2, 0, 0, 0)))
    np.testing.assert_allclose(stepped.answer(46, pose), GOAL, atol=1e-6)
    np.testing.assert_allclose(stepped.answer(30, [*pose, *START, 1e-10, 1e-10]), GOAL, atol=1e-6)
    np.testing.assert_allclose(stepped.answer(44, [*GOAL, 0, 0, 0.2, 0, 0, 0]), pose, atol=1e-9)
    assert stepped.flag(60, pose) == 1
    assert stepped.flag(61, [*pose, *START, 1e-10, 1e-10]) == 1
    assert stepped.flag(60, [3, 0, 0, 0, 0, 0]) == 0
    assert stepped.flag(36, pose) == 1
    assert stepped.flag(37, GOAL) == 1
    assert stepped.flag(37, [7, 0, 0, 0, 0, 0]) == 0
    moved = stepped.answer(39, [0.1, 0, 0, 0, 0, np.pi / 2, 0.2, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(moved, [0.1, 0.2, 0, 0, 0, np.pi / 2], atol=1e-12)


def test_steadiness_is_told(stepped: SteppedControlLoop) -> None:
    assert stepped.flag(47) == 1
    stepped.set(SPEED_J, [0.1, 0, 0, 0, 0, 0, 1.0, 0.004])
    stepped.seconds(0.2)
    stepped.set(0)
    stepped.tick()
    assert stepped.flag(47) == 0


def test_what_a_realtime_question_answers(stepped: SteppedControlLoop) -> None:
    stepped.set(26)
    stepped.tick()
    assert stepped.controller.registers.output_double[0] == 0.002
    stepped.set(27, ints=[5])
    stepped.tick()
    np.testing.assert_allclose(stepped.controller.registers.output_double[:6], START)


def test_an_unreachable_pose_kills_the_script(stepped: SteppedControlLoop) -> None:
    assert not stepped.call(MOVE_L, [3, 0, 0, 0, 0, 0, 0.1, 1.0], [0])
    assert stepped.controller.runtime is RuntimeState.STOPPED
    assert "cannot find a solution" in stepped.notes()
    np.testing.assert_array_equal(stepped.q, START)


@pytest.mark.parametrize("command", [MOVE_L, MOVE_J_IK, 46, SERVO_L])
def test_without_inverse_kinematics_scripts_die(stepped: SteppedControlLoop, command: int) -> None:
    stepped.controller.arm.reachable = False
    assert not stepped.call(command, [*above(START, 0.05), 0.1, 1.0, 0.002, 0.1, 300], [0])


def test_stop_script_ends_the_program(stepped: SteppedControlLoop) -> None:
    stepped.set(STOP_SCRIPT)
    stepped.tick()
    assert stepped.controller.runtime is RuntimeState.STOPPED


def test_the_watchdog_ends_the_program_and_the_arm_brakes(stepped: SteppedControlLoop) -> None:
    assert stepped.call(WATCHDOG, [10.0])
    stepped.set(SPEED_J, [1.0, 0, 0, 0, 0, 0, 5.0, 0.004])
    for _ in range(20):
        stepped.seconds(0.05)
        stepped.controller.wrote(("input_int_register_0",))
    assert stepped.running
    speed = stepped.controller.arm.momentum[0]
    stepped.seconds(0.11)
    assert stepped.controller.runtime is RuntimeState.STOPPED
    assert "watchdog" in stepped.notes()
    at = stepped.q[0]
    stepped.rest(speed / 20 + 0.01)
    assert stepped.q[0] - at <= speed**2 / 2 / 20 + 0.01


def test_without_a_watchdog_a_motion_goes_on(stepped: SteppedControlLoop) -> None:
    stepped.set(SPEED_J, [0.1, 0, 0, 0, 0, 0, 5.0, 0.004])
    stepped.seconds(5.0)
    assert stepped.running
    assert stepped.controller.arm.momentum[0] == pytest.approx(0.1)


def test_a_move_until_contact_goes_back_to_where_it_touched(stepped: SteppedControlLoop) -> None:
    stepped.set(51, [0, 0, -0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5])
    stepped.seconds(0.5)
    touched = stepped.q.copy()
    stepped.push[:3] = [0, 0, 20.0]
    stepped.seconds(0.02)
    assert stepped.call(51, [0, 0, -0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5])
    stepped.rest()
    np.testing.assert_allclose(stepped.q, touched, atol=1e-3)


def test_contact_detection_stops_an_asynchronous_move(stepped: SteppedControlLoop) -> None:
    assert stepped.call(62, [0, 0, -1, 0, 0, 0])
    assert stepped.call(MOVE_L, [*above(START, -0.2), 0.1, 1.0], [1])
    stepped.seconds(0.5)
    assert stepped.flag(64) == 0
    # Pushed along the way, or to the side, is no contact against it.
    stepped.push[:3] = [20.0, 0, -20.0]
    stepped.seconds(0.1)
    assert stepped.flag(64) == 0
    stepped.push[:3] = [0, 0, 20.0]
    stepped.seconds(1.0)
    stepped.push[:3] = 0
    assert stepped.flag(63) > 0
    assert not stepped.word()[1]
    assert ur5e.forward(stepped.q)[2, 3] > ur5e.forward(START)[2, 3] - 0.1


def test_force_mode_gives_way_and_ends(stepped: SteppedControlLoop) -> None:
    stepped.set(FORCE_MODE, [*[0] * 6, 0, 0, -10.0, 0, 0, 0, *[0.05] * 6], [2, 0, 0, 1, 0, 0, 0])
    stepped.seconds(1.0)
    assert ur5e.forward(stepped.q)[2, 3] == pytest.approx(ur5e.forward(START)[2, 3] - 0.005, abs=1e-3)
    assert stepped.call(FORCE_MODE_STOP)
    stepped.rest(0.2)
    assert stepped.controller.arm.force_mode is None


def test_zeroing_the_sensor(stepped: SteppedControlLoop) -> None:
    stepped.push[:3] = [0, 0, 5.0]
    stepped.tick()
    assert stepped.call(ZERO_FT)
    stepped.tick()
    np.testing.assert_allclose(stepped.controller.arm.tcp_wrench, np.zeros(6))


def test_freedrive_follows_the_joints_and_ends(stepped: SteppedControlLoop) -> None:
    assert stepped.call(52, [0] * 6, [1] * 6)
    stepped.q = stepped.q + 0.01
    stepped.tick()
    np.testing.assert_allclose(stepped.controller.arm.q, stepped.q)
    assert stepped.flag(54) == 0
    assert stepped.call(53)
    assert not stepped.controller.arm.freedrive


def test_jogging_along_the_tool(stepped: SteppedControlLoop) -> None:
    assert stepped.call(41, [0, 0, 0.05, 0, 0, 0, 1, 0.5, *[0] * 6])
    stepped.seconds(0.5)
    twist = stepped.controller.arm.twist(stepped.q, stepped.controller.arm.qd)
    np.testing.assert_allclose(twist[:3], ur5e.forward(stepped.q)[:3, 2] * 0.05, atol=2e-3)
    assert stepped.call(42)
    stepped.rest(0.2)


def test_a_protective_stop_on_demand(stepped: SteppedControlLoop) -> None:
    assert stepped.call(MOVE_J, [*GOAL, 0.5, 2.0], [1])
    stepped.seconds(0.1)
    stepped.set(31)
    stepped.tick(3)
    assert stepped.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert stepped.controller.runtime is RuntimeState.PAUSED
    # The word keeps saying that the move runs, as on the real controller.
    assert stepped.word()[1]


def test_an_unknown_command_is_done_at_once(stepped: SteppedControlLoop) -> None:
    assert stepped.call(99)
    assert stepped.running


def test_every_command_can_be_repeated(stepped: SteppedControlLoop) -> None:
    for _ in range(3):
        assert stepped.call(MOVE_J, [*GOAL, 2.0, 10.0], [0])
        assert stepped.call(MOVE_J, [*START, 2.0, 10.0], [0])
    np.testing.assert_allclose(stepped.q, START)


def test_the_way_point_is_that_of_the_move_under_way(stepped: SteppedControlLoop) -> None:
    pose = above(START, 0.05)
    assert stepped.call(MOVE_L, [*pose, 0.1, 1.0], [1])
    stepped.seconds(0.1)
    np.testing.assert_allclose(stepped.answer(28), pose, atol=1e-6)


NUMBERS = st.one_of(st.floats(), st.floats(-4, 4), st.sampled_from([0.0, 1.0, 0.1, 1e-9, *START_Q]))
COMMANDS = st.sampled_from([*range(1, 5), *range(6, 13), 15, 16, *range(17, 22), *range(24, 72), 254, 255, -1])


@given(
    st.lists(
        st.tuples(COMMANDS, st.lists(NUMBERS, min_size=18, max_size=18), st.lists(st.integers(-2, 3), max_size=7)),
        min_size=1,
        max_size=4,
    )
)
@settings(max_examples=60)
def test_no_command_takes_the_controller_down(calls: list[tuple[int, list[float], list[int]]]) -> None:
    stepped = SteppedControlLoop()
    controller = stepped.controller
    path = [stepped.q]
    for command, doubles, ints in calls:
        stepped.set(command, doubles, ints)
        for _ in range(20):
            stepped.tick()
            path.append(controller.arm.q)
        stepped.set(0)
        stepped.tick(2)
        path.append(controller.arm.q)
        # Everything that can be asked for can be sent.
        snapshot = Snapshot(controller)
        assert np.isfinite(
            [value for name in OUTPUTS for value in np.ravel(snapshot[name]) if "input" not in name]
        ).all()
    steps = np.abs(np.diff(np.array(path), axis=0))
    # Half more than the fastest joint, for two periods.
    assert steps.max() <= 2 * 1.5 * ur5e.MAX_JOINT_SPEED * 0.002 + 1e-9
