"""Modes, safety and programs of the served controller, and the words of its dashboard."""

from __future__ import annotations

import itertools
import multiprocessing
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.geometry import ur5e
from sim_twin.wire.faults import Fault, FaultInbox, Kind
from sim_twin.wire.shared_state import CELL_STATE
from sim_twin.wire.ur.controller import UNLOCK_AFTER_S
from sim_twin.wire.ur.dashboard import DashboardSession
from sim_twin.wire.ur.launch import launch
from sim_twin.wire.ur.modes import RobotMode, RuntimeState, SafetyMode
from sim_twin.wire.ur.pose import matrix_to_pose
from sim_twin.wire.ur.server import ARM_FAULTS
from sim_twin.wire.ur.snapshot import Snapshot
from sim_twin.wire.ur.state_faults import StateFaults
from tests.sim_twin.wire.ur.stepped_controller import SteppedController, SteppedControlLoop, answers, received
from tests.sim_twin.wire.ur.stub_world import START_Q

if TYPE_CHECKING:
    from collections.abc import Iterator

START = np.array(START_Q)
MOVE_J = 1


def moving() -> SteppedControlLoop:
    """An arm in the middle of a long move at 1 rad/s."""
    stepped = SteppedControlLoop()
    assert stepped.call(MOVE_J, [*(START + np.array([2.0, 0, 0, 0, 0, 0])), 1.0, 10.0], [1])
    stepped.seconds(0.5)
    assert stepped.controller.arm.momentum[0] == pytest.approx(1.0)
    return stepped


def ask(stepped: SteppedController, *lines: str) -> list[str]:
    """What the dashboard answers to each line."""
    answer = answers(DashboardSession(stepped.controller), "".join(f"{line}\n" for line in lines).encode())
    return answer.decode().splitlines()


def send(stepped: SteppedController, text: str) -> None:
    """Send what the controller is to run."""
    for one in received(text.encode()):
        launch(stepped.controller, one)


def run(stepped: SteppedController, text: str, limit: float = 20.0) -> None:
    """Send a program and wait until it has ended."""
    send(stepped, text)
    for _ in range(round(limit / 0.002)):
        stepped.tick()
        if stepped.controller.runtime is RuntimeState.STOPPED:
            stepped.rest()
            return
    raise AssertionError("the program does not end")


# Protective stop


def test_a_push_of_more_than_150_n_stops_the_arm_and_pauses_the_program() -> None:
    stepped = moving()
    stepped.push[:3] = [0, 0, 149.0]
    stepped.tick(5)
    assert stepped.controller.safe
    stepped.push[:3] = [0, 0, 151.0]
    stepped.tick()
    assert stepped.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert stepped.controller.runtime is RuntimeState.PAUSED
    bits = Snapshot(stepped.controller)["safety_status_bits"]
    assert bits == 1 << 2 | 1 << 10
    at = stepped.q.copy()
    stepped.seconds(0.2)
    np.testing.assert_array_equal(stepped.q, at)


def test_a_joint_that_cannot_follow_stops_the_arm() -> None:
    stepped = moving()
    stepped.held = True
    stepped.seconds(0.2)
    assert stepped.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    # It holds where it is.
    np.testing.assert_array_equal(stepped.controller.arm.q, stepped.q)


def test_an_arm_that_is_pushed_aside_at_rest_stops() -> None:
    stepped = SteppedController()
    stepped.tick(5)
    stepped.held = True
    stepped.q = stepped.q + 0.06
    stepped.tick()
    assert stepped.controller.safety_mode is SafetyMode.PROTECTIVE_STOP


def test_a_world_that_stalls_is_waited_for() -> None:
    stepped = moving()
    stale = stepped.now
    for _ in range(200):
        cells = np.zeros(1, CELL_STATE)
        cells["q"], cells["wall"] = stepped.q, stale
        stepped.controller.tick(stepped.now, cells[0])
        stepped.now += 0.002
    assert stepped.controller.safe
    assert np.abs(stepped.controller.arm.q - stepped.q).max() < 0.05
    stepped.rest()
    assert stepped.controller.safe
    np.testing.assert_allclose(stepped.q[0], START[0] + 2.0)


def test_a_protective_stop_is_unlocked_after_five_seconds_and_the_program_stays_paused() -> None:
    stepped = moving()
    stepped.push[:3] = [0, 0, 200.0]
    stepped.tick()
    stepped.seconds(UNLOCK_AFTER_S - 0.1)
    [answer] = ask(stepped, "unlock protective stop")
    assert answer.startswith("Cannot unlock protective stop until 5s after occurrence")
    assert stepped.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    stepped.seconds(0.2)
    assert ask(stepped, "close safety popup", "unlock protective stop", "safetymode", "programState") == [
        "closing safety popup",
        "Protective stop releasing",
        "Safetymode: NORMAL",
        "PAUSED rtde_control",
    ]
    # It can leave the contact that stopped it.
    stepped.seconds(0.5)
    assert stepped.controller.safe
    stepped.push[:3] = [0, 0, 231.0]
    stepped.tick()
    assert not stepped.controller.safe


def test_a_new_script_runs_after_a_protective_stop_only_when_it_is_unlocked() -> None:
    stepped = moving()
    stepped.controller.protective_stop("test")
    assert not stepped.controller.start(SteppedControlLoop().loop.program)
    stepped.seconds(UNLOCK_AFTER_S + 0.1)
    ask(stepped, "unlock protective stop")
    again = SteppedControlLoop()
    assert stepped.controller.start(again.loop.program)
    assert stepped.controller.runtime is RuntimeState.PLAYING


# The program


def test_a_pause_brakes_on_the_path_and_play_goes_on() -> None:
    stepped = moving()
    assert ask(stepped, "pause", "running") == ["Pausing program", "Program running: false"]
    stepped.rest(0.2)
    assert ask(stepped, "programState") == ["PAUSED rtde_control"]
    at = stepped.q.copy()
    stepped.seconds(1.0)
    np.testing.assert_array_equal(stepped.q, at)
    assert ask(stepped, "play", "running") == ["Starting program", "Program running: true"]
    stepped.rest()
    np.testing.assert_allclose(stepped.q[0], START[0] + 2.0)


def test_an_arm_that_was_moved_while_paused_does_not_jump() -> None:
    stepped = moving()
    ask(stepped, "pause")
    stepped.rest(0.2)
    stepped.controller.protective_stop("test")
    stepped.q, stepped.held = stepped.q - 0.3, True
    stepped.seconds(UNLOCK_AFTER_S + 0.1)
    stepped.held = False
    at = stepped.q.copy()
    ask(stepped, "unlock protective stop", "play")
    stepped.seconds(0.2)
    assert stepped.controller.safe
    assert stepped.controller.runtime is RuntimeState.STOPPED
    np.testing.assert_allclose(stepped.q, at, atol=0.02)


def test_a_program_that_is_stopped_lets_the_arm_brake() -> None:
    stepped = moving()
    at = stepped.q[0]
    assert ask(stepped, "stop") == ["Stopped"]
    assert stepped.controller.runtime is RuntimeState.STOPPED
    stepped.rest(1.0 / 20 + 0.01)
    assert stepped.q[0] - at == pytest.approx(1.0 / 2 / 20, abs=0.003)


def test_the_speed_slider_slows_the_arm() -> None:
    stepped = moving()
    stepped.controller.slider = 0.3
    stepped.seconds(0.3)
    assert stepped.controller.arm.qd[0] == pytest.approx(0.3)
    snapshot = Snapshot(stepped.controller)
    assert (snapshot["target_speed_fraction"], snapshot["speed_scaling"]) == (0.3, pytest.approx(0.3))
    stepped.controller.slider = 0.0
    stepped.seconds(0.3)
    at = stepped.q.copy()
    stepped.seconds(1.0)
    np.testing.assert_array_equal(stepped.q, at)
    stepped.controller.slider = 1.0
    stepped.rest()
    np.testing.assert_allclose(stepped.q[0], START[0] + 2.0)


@given(st.lists(st.sampled_from([0.0, 0.1, 0.5, 1.0, "pause", "play"]), min_size=1, max_size=8))
@settings(max_examples=25)
def test_whatever_the_operator_does_the_joints_keep_their_limits(deeds: list[float | str]) -> None:
    stepped = SteppedControlLoop()
    assert stepped.call(MOVE_J, [*(START + np.array([1.0, 0.5, 0, 0, 0, 0])), 1.5, 5.0], [1])
    path = [stepped.q]
    for deed in deeds:
        if isinstance(deed, str):
            ask(stepped, deed)
        else:
            stepped.controller.slider = deed
        for _ in range(60):
            stepped.tick()
            path.append(stepped.q)
    joints = np.array(path)
    assert np.abs(np.diff(joints, axis=0)).max() <= 1.5 * 0.002 + 1e-9
    # Slider and pause change the speed by at most 6 times the full one per second.
    assert np.abs(np.diff(joints, n=2, axis=0)).max() <= (5.0 + 6 * 1.5) * 0.002**2 + 1e-9
    # The arm is on its path: both joints have gone the same share of their way.
    np.testing.assert_allclose(joints[:, 0] - START[0], 2 * (joints[:, 1] - START[1]), atol=1e-9)


def test_statements_are_carried_out_in_order() -> None:
    stepped = SteppedController()
    run(
        stepped,
        "def job():\n"
        "  set_tcp(p[0,0,0.1,0,0,0])\n"
        "  set_payload(1.5, [0,0,0.05])\n"
        "  movej([0.2,-1.57,1.57,-1.57,-1.57,0], a=2, v=1)\n"
        "  set_digital_out(3, True)\n"
        "  sleep(0.1)\n"
        "  write_output_integer_register(0 +1, 7)\n"
        "  write_output_float_register(2, 0.5)\n"
        '  textmsg("at ", 3)\n'
        "end\n",
    )
    controller = stepped.controller
    np.testing.assert_allclose(stepped.q[0], 0.2)
    assert controller.arm.tcp == (0, 0, 0.1, 0, 0, 0)
    assert (controller.payload.mass, controller.payload.cog) == (1.5, (0, 0, 0.05))
    assert controller.outputs.digital == 1 << 3
    assert (controller.registers.output_int[1], controller.registers.output_double[2]) == (7, 0.5)
    assert "textmsg: at 3" in stepped.notes()


def test_one_line_is_a_program() -> None:
    stepped = SteppedController()
    T = ur5e.forward(START)
    T[2, 3] += 0.05
    run(stepped, f"movel(p{list(matrix_to_pose(T))}, a=1.2, v=0.25)\n")
    np.testing.assert_allclose(ur5e.forward(stepped.q), T, atol=1e-9)
    run(stepped, "speedj([0.2,0,0,0,0,0], 1.0, 0.5)\n")
    run(stepped, "stopj(2)\n")
    assert stepped.controller.safe


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fly_away(1)\n", "does not know fly_away"),
        ("def p():\n  x = 1\nend\n", "line 2"),
        ("movej([1,2,3])\n", "6 numbers"),
        ("movel(p[3,0,0,0,0,0])\n", "cannot find a solution"),
        ("set_digital_out(99, True)\n", "only 18"),
        ("movej([0,0,0,0,0,0], t=3)\n", "duration"),
        ("set_payload(-1)\n", "negative"),
    ],
)
def test_what_a_script_may_not_is_said_and_ends_it(text: str, says: str) -> None:
    stepped = SteppedController()
    run(stepped, text)
    assert says in stepped.notes()
    np.testing.assert_array_equal(stepped.q, START)


def test_a_secondary_program_runs_beside_the_main_one() -> None:
    stepped = moving()
    send(stepped, "sec s():\n  set_digital_out(0, True)\nend\n")
    assert stepped.controller.outputs.digital == 1
    assert stepped.running
    for text in ("sec s():\n  sleep(1)\nend\n", "sec s():\n" + "  sync()\n" * 21 + "end\n", "sec s():\n x=1\nend\n"):
        send(stepped, text)
        assert stepped.running, text
    assert "must not move" in stepped.notes()
    assert "more than 20" in stepped.notes()
    assert "syntax_error_on_line:2:x=1:" in stepped.notes()


# Power and stops


def test_power_and_brakes_take_their_time() -> None:
    stepped = SteppedControlLoop()
    assert ask(stepped, "power off", "robotmode", "programState") == [
        "Powering off",
        "Robotmode: POWER_OFF",
        "STOPPED null",
    ]
    assert not stepped.controller.powered
    assert ask(stepped, "power on") == ["Powering on"]
    stepped.tick()
    assert ask(stepped, "robotmode") == ["Robotmode: POWER_ON"]
    stepped.seconds(1.0)
    assert ask(stepped, "robotmode", "brake release") == ["Robotmode: IDLE", "Brake releasing"]
    stepped.seconds(1.0)
    assert ask(stepped, "robotmode") == ["Robotmode: RUNNING"]


def test_brake_release_also_powers_on() -> None:
    stepped = SteppedController()
    ask(stepped, "power off", "brake release")
    stepped.seconds(2.0)
    assert stepped.controller.robot_mode is RobotMode.RUNNING


def test_an_emergency_stop_cuts_the_power() -> None:
    stepped = moving()
    stepped.controller.emergency_stop()
    stepped.tick(3)
    snapshot = Snapshot(stepped.controller)
    bits = snapshot["safety_status_bits"]
    assert isinstance(bits, int)
    assert bits >> 7 & 1
    assert (snapshot["robot_mode"], snapshot["safety_mode"], snapshot["runtime_state"]) == (3, 7, 1)
    ask(stepped, "power on", "brake release")
    stepped.seconds(2.0)
    assert stepped.controller.robot_mode is RobotMode.POWER_OFF


def test_local_control_refuses_scripts_and_most_of_the_dashboard() -> None:
    stepped = SteppedController()
    stepped.controller.remote = False
    assert ask(stepped, "is in remote control", "robotmode") == ["false", "Robotmode: RUNNING"]
    assert set(ask(stepped, "play", "power on", "brake release", "unlock protective stop")) == {
        "Command is not allowed due to safety reasons"
    }
    assert not stepped.controller.start(SteppedControlLoop().loop.program)
    assert "local control" in stepped.notes()


# The dashboard's words


def test_the_dashboard_speaks_as_the_controller_does() -> None:
    stepped = SteppedController()
    talk = {
        "PolyscopeVersion": "URSoftware 5.12.",
        "get serial number": "20",
        "get robot model": "UR5",
        "is in remote control": "true",
        "robotmode": "Robotmode: RUNNING",
        "safetymode": "Safetymode: NORMAL",
        "safetystatus": "Safetystatus: NORMAL",
        "programState": "STOPPED",
        "running": "Program running: false",
        "get loaded program": "No program loaded",
        "isProgramSaved": "true null",
        "saveLog": "Log saved to disk",
        "generate flight report": "Flight Report generated with id: ",
        "generate flight report controller": "Flight Report generated with id: ",
        "generate flight report lunch": "Error generating flight report: lunch",
        "generate support file /programs": "Completed successfully: ur_2",
        "generate support file": "Error",
        "get operational mode": "NONE",
        "set operational mode manual": "Operational mode manual is set",
        "play": "Failed to execute: play",
        "pause": "Failed to execute: pause",
        "stop": "Stopped",
        "load job.urp": "File not found: job.urp",
        "popup a b": "showing popup",
        "close popup": "closing popup",
        "close safety popup": "closing safety popup",
        "addToLog x": "Added log message",
        "restart safety": "Restarting safety",
        "unlock protective stop": "Protective stop releasing",
        "nonsense": 'could not understand: "nonsense"',
        "shutdown": "Shutting down",
    }
    said = ask(stepped, *talk)
    assert len(said) == len(talk)
    wrong = {
        line: answer for (line, start), answer in zip(talk.items(), said, strict=True) if answer[: len(start)] != start
    }
    assert not wrong
    assert said[1].isdigit()


def test_the_operational_mode_is_read_back() -> None:
    stepped = SteppedController()
    mode = "get operational mode"
    assert ask(stepped, "set operational mode AUTOMATIC", mode) == ["Operational mode AUTOMATIC is set", "AUTOMATIC"]
    assert ask(stepped, "set operational mode lunch", mode) == ["Failed setting operational mode: lunch", "AUTOMATIC"]
    assert ask(stepped, "clear operational mode", mode) == [
        "No longer controlling the operational mode. Current operational mode: 'NONE'.",
        "NONE",
    ]


def test_the_program_that_runs_is_named() -> None:
    stepped = SteppedController()
    send(stepped, "def stacking():\n  sleep(1)\nend\n")
    assert ask(stepped, "programState", "isProgramSaved") == ["PLAYING stacking", "true stacking"]


def test_nothing_is_answered_after_a_goodbye() -> None:
    session = DashboardSession(SteppedController().controller)
    assert answers(session, b"quit\nrobotmode\n") == b"Disconnected\n"
    assert session.ended


@given(st.lists(st.sampled_from([b"robotmode\n", b"\n", b"\xff\x00\n", b"stop\r\n"])), st.lists(st.integers(0, 60)))
def test_lines_may_come_in_pieces(lines: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(lines)
    whole = answers(DashboardSession(SteppedController().controller), stream)
    assert whole.count(b"\n") == len(lines)
    session = DashboardSession(SteppedController().controller)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert b"".join(answers(session, stream[a:b]) for a, b in itertools.pairwise(edges)) == whole


# Faults of the state


class Injector:
    """Puts faults into the controller of a stepped."""

    def __init__(self, stepped: SteppedController) -> None:
        here, self._there = multiprocessing.Pipe(duplex=False)
        self._here = here
        self._inbox = FaultInbox(here, "arm")
        self._faults = StateFaults(stepped.controller)

    def set(self, *whats: str, value: float | None = None) -> None:
        self._there.send(tuple(Fault("arm", "state", Kind.WRONG, what, value) for what in whats))
        self._inbox.poll()
        self._faults.apply(self._inbox)

    def close(self) -> None:
        self._here.close()
        self._there.close()


@pytest.fixture
def stepped() -> SteppedControlLoop:
    return moving()


@pytest.fixture
def inject(stepped: SteppedControlLoop) -> Iterator[Injector]:
    injector = Injector(stepped)
    yield injector
    injector.close()


@pytest.mark.parametrize(
    ("what", "mode", "safety", "runtime"),
    [
        ("power_off", RobotMode.POWER_OFF, SafetyMode.NORMAL, RuntimeState.STOPPED),
        ("brakes_locked", RobotMode.IDLE, SafetyMode.NORMAL, RuntimeState.STOPPED),
        ("booting", RobotMode.BOOTING, SafetyMode.NORMAL, RuntimeState.STOPPED),
        ("emergency_stop", RobotMode.POWER_OFF, SafetyMode.ROBOT_EMERGENCY_STOP, RuntimeState.STOPPED),
        ("violation", RobotMode.POWER_OFF, SafetyMode.VIOLATION, RuntimeState.STOPPED),
        ("safeguard_stop", RobotMode.RUNNING, SafetyMode.SAFEGUARD_STOP, RuntimeState.PAUSED),
        ("protective_stop", RobotMode.RUNNING, SafetyMode.PROTECTIVE_STOP, RuntimeState.PAUSED),
        ("program_stopped", RobotMode.RUNNING, SafetyMode.NORMAL, RuntimeState.STOPPED),
        ("program_paused", RobotMode.RUNNING, SafetyMode.NORMAL, RuntimeState.PAUSED),
    ],
)
def test_a_fault_of_the_state_stops_the_arm(
    stepped: SteppedControlLoop, inject: Injector, what: str, mode: RobotMode, safety: SafetyMode, runtime: RuntimeState
) -> None:
    inject.set(what)
    stepped.rest(0.3)
    controller = stepped.controller
    assert (controller.robot_mode, controller.safety_mode, controller.runtime) == (mode, safety, runtime)
    inject.set()
    stepped.tick()
    if what == "protective_stop":
        stepped.seconds(UNLOCK_AFTER_S)
        ask(stepped, "unlock protective stop")
    assert (controller.robot_mode, controller.safety_mode) == (RobotMode.RUNNING, SafetyMode.NORMAL)
    assert controller.start(SteppedControlLoop().loop.program)


def test_a_condition_holds_on_when_another_one_is_lifted(stepped: SteppedControlLoop, inject: Injector) -> None:
    inject.set("power_off", "emergency_stop")
    assert stepped.controller.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP
    inject.set("power_off")
    assert (stepped.controller.robot_mode, stepped.controller.safety_mode) == (RobotMode.POWER_OFF, SafetyMode.NORMAL)


def test_a_move_that_never_arrives(stepped: SteppedControlLoop, inject: Injector) -> None:
    inject.set("never_arrives")
    stepped.seconds(10)
    assert stepped.word()[1]
    np.testing.assert_allclose(stepped.q[0], START[0] + 2.0)
    inject.set()
    stepped.seconds(0.1)
    assert not stepped.word()[1]


def test_a_slider_that_somebody_holds(stepped: SteppedControlLoop, inject: Injector) -> None:
    inject.set("speed_slider", value=0.2)
    stepped.controller.slider = 1.0
    stepped.seconds(0.5)
    assert stepped.controller.arm.qd[0] == pytest.approx(0.2)


def test_tcp_and_payload_that_are_not_taken(stepped: SteppedControlLoop, inject: Injector) -> None:
    inject.set("tcp", "payload", "local_control")
    stepped.controller.set_tcp((0, 0, 0.2, 0, 0, 0))
    assert stepped.controller.arm.tcp != (0, 0, 0.2, 0, 0, 0)
    assert stepped.controller.payload.mass > 0
    assert not stepped.controller.remote
    inject.set()
    stepped.controller.set_tcp((0, 0, 0.2, 0, 0, 0))
    assert stepped.controller.arm.tcp == (0, 0, 0.2, 0, 0, 0)
    assert stepped.controller.remote


def test_the_declared_faults_are_those_that_are_known() -> None:
    assert {what for channel, _, what in ARM_FAULTS if channel == "state"} >= {
        *("local_control", "power_off", "brakes_locked", "booting", "protective_stop", "safeguard_stop"),
        *("emergency_stop", "violation", "speed_slider", "program_stopped", "program_paused", "never_arrives"),
        *("tcp", "payload"),
    }
