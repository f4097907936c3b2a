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
from sim_twin.wire.ur.controller import UNLOCK_AFTER_S, RobotMode, RuntimeState, SafetyMode
from sim_twin.wire.ur.dashboard import DashboardSession
from sim_twin.wire.ur.pose import matrix_to_pose
from sim_twin.wire.ur.program import Program, ScriptError
from sim_twin.wire.ur.script import ScriptReader
from sim_twin.wire.ur.server import FAULTS
from sim_twin.wire.ur.snapshot import Snapshot
from sim_twin.wire.ur.state_faults import StateFaults
from sim_twin.wire.ur.statements import run_at_once, run_statements
from tests.sim_twin.wire.ur.stepped_controller import LoopRig, Rig
from tests.sim_twin.wire.ur.stub_world import START_Q

if TYPE_CHECKING:
    from collections.abc import Iterator

START = np.array(START_Q)
MOVE_J = 1


def moving() -> LoopRig:
    """An arm in the middle of a long move at 1 rad/s."""
    rig = LoopRig()
    assert rig.call(MOVE_J, [*(START + np.array([2.0, 0, 0, 0, 0, 0])), 1.0, 10.0], [1])
    rig.seconds(0.5)
    assert rig.controller.arm.momentum[0] == pytest.approx(1.0)
    return rig


def ask(rig: Rig, *lines: str) -> list[str]:
    """What the dashboard answers to each line."""
    answer = DashboardSession(rig.controller).feed("".join(f"{line}\n" for line in lines).encode())
    return answer.decode().splitlines()


def run(rig: Rig, text: str, limit: float = 20.0) -> None:
    """Send a program and wait until it has ended."""
    [script] = ScriptReader().feed(text.encode())
    assert rig.controller.start(Program(script.name, run_statements(rig.controller, script.statements())))
    for _ in range(round(limit / 0.002)):
        rig.tick()
        if rig.controller.runtime is RuntimeState.STOPPED:
            rig.rest()
            return
    raise AssertionError("the program does not end")


# Protective stop


def test_a_push_of_more_than_150_n_stops_the_arm_and_pauses_the_program() -> None:
    rig = moving()
    rig.push[:3] = [0, 0, 149.0]
    rig.tick(5)
    assert rig.controller.safe
    rig.push[:3] = [0, 0, 151.0]
    rig.tick()
    assert rig.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert rig.controller.runtime is RuntimeState.PAUSED
    bits = Snapshot(rig.controller)["safety_status_bits"]
    assert bits == 1 << 2 | 1 << 10
    at = rig.q.copy()
    rig.seconds(0.2)
    np.testing.assert_array_equal(rig.q, at)


def test_a_joint_that_cannot_follow_stops_the_arm() -> None:
    rig = moving()
    rig.held = True
    rig.seconds(0.2)
    assert rig.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    # It holds where it is.
    np.testing.assert_array_equal(rig.controller.arm.q, rig.q)


def test_an_arm_that_is_pushed_aside_at_rest_stops() -> None:
    rig = Rig()
    rig.tick(5)
    rig.held = True
    rig.q = rig.q + 0.06
    rig.tick()
    assert rig.controller.safety_mode is SafetyMode.PROTECTIVE_STOP


def test_a_world_that_stalls_is_waited_for() -> None:
    rig = moving()
    stale = rig.now
    for _ in range(200):
        cells = np.zeros(1, CELL_STATE)
        cells["q"], cells["wall"] = rig.q, stale
        rig.controller.tick(rig.now, cells[0])
        rig.now += 0.002
    assert rig.controller.safe
    assert np.abs(rig.controller.arm.q - rig.q).max() < 0.05
    rig.rest()
    assert rig.controller.safe
    np.testing.assert_allclose(rig.q[0], START[0] + 2.0)


def test_a_protective_stop_is_unlocked_after_five_seconds_and_the_program_stays_paused() -> None:
    rig = moving()
    rig.push[:3] = [0, 0, 200.0]
    rig.tick()
    rig.seconds(UNLOCK_AFTER_S - 0.1)
    [answer] = ask(rig, "unlock protective stop")
    assert answer.startswith("Cannot unlock protective stop until 5s after occurrence")
    assert rig.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    rig.seconds(0.2)
    assert ask(rig, "close safety popup", "unlock protective stop", "safetymode", "programState") == [
        "closing safety popup",
        "Protective stop releasing",
        "Safetymode: NORMAL",
        "PAUSED rtde_control",
    ]
    # It can leave the contact that stopped it.
    rig.seconds(0.5)
    assert rig.controller.safe
    rig.push[:3] = [0, 0, 231.0]
    rig.tick()
    assert not rig.controller.safe


def test_a_new_script_runs_after_a_protective_stop_only_when_it_is_unlocked() -> None:
    rig = moving()
    rig.controller.protective_stop("test")
    assert not rig.controller.start(LoopRig().loop.program)
    rig.seconds(UNLOCK_AFTER_S + 0.1)
    ask(rig, "unlock protective stop")
    again = LoopRig()
    assert rig.controller.start(again.loop.program)
    assert rig.controller.runtime is RuntimeState.PLAYING


# The program


def test_a_pause_brakes_on_the_path_and_play_goes_on() -> None:
    rig = moving()
    assert ask(rig, "pause", "running") == ["Pausing program", "Program running: false"]
    rig.rest(0.2)
    assert ask(rig, "programState") == ["PAUSED rtde_control"]
    at = rig.q.copy()
    rig.seconds(1.0)
    np.testing.assert_array_equal(rig.q, at)
    assert ask(rig, "play", "running") == ["Starting program", "Program running: true"]
    rig.rest()
    np.testing.assert_allclose(rig.q[0], START[0] + 2.0)


def test_an_arm_that_was_moved_while_paused_does_not_jump() -> None:
    rig = moving()
    ask(rig, "pause")
    rig.rest(0.2)
    rig.controller.protective_stop("test")
    rig.q, rig.held = rig.q - 0.3, True
    rig.seconds(UNLOCK_AFTER_S + 0.1)
    rig.held = False
    at = rig.q.copy()
    ask(rig, "unlock protective stop", "play")
    rig.seconds(0.2)
    assert rig.controller.safe
    assert rig.controller.runtime is RuntimeState.STOPPED
    np.testing.assert_allclose(rig.q, at, atol=0.02)


def test_a_program_that_is_stopped_lets_the_arm_brake() -> None:
    rig = moving()
    at = rig.q[0]
    assert ask(rig, "stop") == ["Stopped"]
    assert rig.controller.runtime is RuntimeState.STOPPED
    rig.rest(1.0 / 20 + 0.01)
    assert rig.q[0] - at == pytest.approx(1.0 / 2 / 20, abs=0.003)


def test_the_speed_slider_slows_the_arm() -> None:
    rig = moving()
    rig.controller.slider = 0.3
    rig.seconds(0.3)
    assert rig.controller.arm.qd[0] == pytest.approx(0.3)
    snapshot = Snapshot(rig.controller)
    assert (snapshot["target_speed_fraction"], snapshot["speed_scaling"]) == (0.3, pytest.approx(0.3))
    rig.controller.slider = 0.0
    rig.seconds(0.3)
    at = rig.q.copy()
    rig.seconds(1.0)
    np.testing.assert_array_equal(rig.q, at)
    rig.controller.slider = 1.0
    rig.rest()
    np.testing.assert_allclose(rig.q[0], START[0] + 2.0)


@given(st.lists(st.sampled_from([0.0, 0.1, 0.5, 1.0, "pause", "play"]), min_size=1, max_size=8))
@settings(max_examples=25)
def test_whatever_the_operator_does_the_joints_keep_their_limits(deeds: list[float | str]) -> None:
    rig = LoopRig()
    assert rig.call(MOVE_J, [*(START + np.array([1.0, 0.5, 0, 0, 0, 0])), 1.5, 5.0], [1])
    path = [rig.q]
    for deed in deeds:
        if isinstance(deed, str):
            ask(rig, deed)
        else:
            rig.controller.slider = deed
        for _ in range(60):
            rig.tick()
            path.append(rig.q)
    joints = np.array(path)
    assert np.abs(np.diff(joints, axis=0)).max() <= 1.5 * 0.002 + 1e-9
    # Slider and pause change the speed by at most 6 times the full one per second.
    assert np.abs(np.diff(joints, n=2, axis=0)).max() <= (5.0 + 6 * 1.5) * 0.002**2 + 1e-9
    # The arm is on its path: both joints have gone the same share of their way.
    np.testing.assert_allclose(joints[:, 0] - START[0], 2 * (joints[:, 1] - START[1]), atol=1e-9)


def test_statements_are_carried_out_in_order() -> None:
    rig = Rig()
    run(
        rig,
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
    controller = rig.controller
    np.testing.assert_allclose(rig.q[0], 0.2)
    assert controller.arm.tcp == (0, 0, 0.1, 0, 0, 0)
    assert (controller.payload.mass, controller.payload.cog) == (1.5, (0, 0, 0.05))
    assert controller.outputs.digital == 1 << 3
    assert (controller.registers.output_int[1], controller.registers.output_double[2]) == (7, 0.5)
    assert "textmsg: at 3" in rig.notes()


def test_one_line_is_a_program() -> None:
    rig = Rig()
    T = ur5e.forward(START)
    T[2, 3] += 0.05
    run(rig, f"movel(p{list(matrix_to_pose(T))}, a=1.2, v=0.25)\n")
    np.testing.assert_allclose(ur5e.forward(rig.q), T, atol=1e-9)
    run(rig, "speedj([0.2,0,0,0,0,0], 1.0, 0.5)\n")
    run(rig, "stopj(2)\n")
    assert rig.controller.safe


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
    rig = Rig()
    try:
        run(rig, text)
    except ScriptError as error:
        assert says in str(error)
    else:
        assert says in rig.notes()
    np.testing.assert_array_equal(rig.q, START)


def test_a_secondary_program_runs_beside_the_main_one() -> None:
    rig = moving()
    [script] = ScriptReader().feed(b"sec s():\n  set_digital_out(0, True)\nend\n")
    run_at_once(rig.controller, script.statements())
    assert rig.controller.outputs.digital == 1
    assert rig.running
    [script] = ScriptReader().feed(b"sec s():\n  sleep(1)\nend\n")
    with pytest.raises(ScriptError, match="must not move"):
        run_at_once(rig.controller, script.statements())


# Power and stops


def test_power_and_brakes_take_their_time() -> None:
    rig = LoopRig()
    assert ask(rig, "power off", "robotmode", "programState") == [
        "Powering off",
        "Robotmode: POWER_OFF",
        "STOPPED null",
    ]
    assert not rig.controller.powered
    assert ask(rig, "power on") == ["Powering on"]
    rig.tick()
    assert ask(rig, "robotmode") == ["Robotmode: POWER_ON"]
    rig.seconds(1.0)
    assert ask(rig, "robotmode", "brake release") == ["Robotmode: IDLE", "Brake releasing"]
    rig.seconds(1.0)
    assert ask(rig, "robotmode") == ["Robotmode: RUNNING"]


def test_brake_release_also_powers_on() -> None:
    rig = Rig()
    ask(rig, "power off", "brake release")
    rig.seconds(2.0)
    assert rig.controller.robot_mode is RobotMode.RUNNING


def test_an_emergency_stop_cuts_the_power() -> None:
    rig = moving()
    rig.controller.emergency_stop()
    rig.tick(3)
    snapshot = Snapshot(rig.controller)
    bits = snapshot["safety_status_bits"]
    assert isinstance(bits, int)
    assert bits >> 7 & 1
    assert (snapshot["robot_mode"], snapshot["safety_mode"], snapshot["runtime_state"]) == (3, 7, 1)
    ask(rig, "power on", "brake release")
    rig.seconds(2.0)
    assert rig.controller.robot_mode is RobotMode.POWER_OFF


def test_local_control_refuses_scripts_and_most_of_the_dashboard() -> None:
    rig = Rig()
    rig.controller.remote = False
    assert ask(rig, "is in remote control", "robotmode") == ["false", "Robotmode: RUNNING"]
    assert set(ask(rig, "play", "power on", "brake release", "unlock protective stop")) == {
        "Command is not allowed due to safety reasons"
    }
    assert not rig.controller.start(LoopRig().loop.program)
    assert "local control" in rig.notes()


# The dashboard's words


def test_the_dashboard_speaks_as_the_controller_does() -> None:
    rig = Rig()
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
        "isProgramSaved": "true",
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
    answers = ask(rig, *talk)
    assert len(answers) == len(talk)
    wrong = {
        line: answer
        for (line, start), answer in zip(talk.items(), answers, strict=True)
        if answer[: len(start)] != start
    }
    assert not wrong
    assert answers[1].isdigit()


def test_nothing_is_answered_after_a_goodbye() -> None:
    session = DashboardSession(Rig().controller)
    assert session.feed(b"quit\nrobotmode\n") == b"Disconnected\n"
    assert session.ended


@given(st.lists(st.sampled_from([b"robotmode\n", b"\n", b"\xff\x00\n", b"stop\r\n"])), st.lists(st.integers(0, 60)))
def test_lines_may_come_in_pieces(lines: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(lines)
    whole = DashboardSession(Rig().controller).feed(stream)
    assert whole.count(b"\n") == len(lines)
    session = DashboardSession(Rig().controller)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert b"".join(session.feed(stream[a:b]) for a, b in itertools.pairwise(edges)) == whole


# Faults of the state


class Injector:
    """Puts faults into the controller of a rig."""

    def __init__(self, rig: Rig) -> None:
        here, self._there = multiprocessing.Pipe(duplex=False)
        self._here = here
        self._inbox = FaultInbox(here, "arm")
        self._faults = StateFaults(rig.controller)

    def set(self, *whats: str, value: float | None = None) -> None:
        self._there.send(tuple(Fault("arm", "state", Kind.WRONG, what, value) for what in whats))
        self._inbox.poll()
        self._faults.apply(self._inbox)

    def close(self) -> None:
        self._here.close()
        self._there.close()


@pytest.fixture
def rig() -> LoopRig:
    return moving()


@pytest.fixture
def inject(rig: LoopRig) -> Iterator[Injector]:
    injector = Injector(rig)
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
    rig: LoopRig, inject: Injector, what: str, mode: RobotMode, safety: SafetyMode, runtime: RuntimeState
) -> None:
    inject.set(what)
    rig.rest(0.3)
    controller = rig.controller
    assert (controller.robot_mode, controller.safety_mode, controller.runtime) == (mode, safety, runtime)
    inject.set()
    rig.tick()
    if what == "protective_stop":
        rig.seconds(UNLOCK_AFTER_S)
        ask(rig, "unlock protective stop")
    assert (controller.robot_mode, controller.safety_mode) == (RobotMode.RUNNING, SafetyMode.NORMAL)
    assert controller.start(LoopRig().loop.program)


def test_a_condition_holds_on_when_another_one_is_lifted(rig: LoopRig, inject: Injector) -> None:
    inject.set("power_off", "emergency_stop")
    assert rig.controller.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP
    inject.set("power_off")
    assert (rig.controller.robot_mode, rig.controller.safety_mode) == (RobotMode.POWER_OFF, SafetyMode.NORMAL)


def test_a_move_that_never_arrives(rig: LoopRig, inject: Injector) -> None:
    inject.set("never_arrives")
    rig.seconds(10)
    assert rig.word()[1]
    np.testing.assert_allclose(rig.q[0], START[0] + 2.0)
    inject.set()
    rig.seconds(0.1)
    assert not rig.word()[1]


def test_a_slider_that_somebody_holds(rig: LoopRig, inject: Injector) -> None:
    inject.set("speed_slider", value=0.2)
    rig.controller.slider = 1.0
    rig.seconds(0.5)
    assert rig.controller.arm.qd[0] == pytest.approx(0.2)


def test_tcp_and_payload_that_are_not_taken(rig: LoopRig, inject: Injector) -> None:
    inject.set("tcp", "payload", "local_control")
    rig.controller.set_tcp((0, 0, 0.2, 0, 0, 0))
    assert rig.controller.arm.tcp != (0, 0, 0.2, 0, 0, 0)
    assert rig.controller.payload.mass > 0
    assert not rig.controller.remote
    inject.set()
    rig.controller.set_tcp((0, 0, 0.2, 0, 0, 0))
    assert rig.controller.arm.tcp == (0, 0, 0.2, 0, 0, 0)
    assert rig.controller.remote


def test_the_declared_faults_are_those_that_are_known() -> None:
    assert {what for channel, _, what in FAULTS if channel == "state"} >= {
        *("local_control", "power_off", "brakes_locked", "booting", "protective_stop", "safeguard_stop"),
        *("emergency_stop", "violation", "speed_slider", "program_stopped", "program_paused", "never_arrives"),
        *("tcp", "payload"),
    }
