"""The served controller over its sockets, by the public protocols alone."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.geometry import ur5e
from sim_twin.wire.faults import Fault, Kind
from sim_twin.wire.ur.pose import matrix_to_pose
from sim_twin.wire.ur.variables import OUTPUTS
from tests.addresses import loopback
from tests.sim_twin.wire.ur.control_script import CONTROL_SCRIPT
from tests.sim_twin.wire.ur.rtde_client import RtdeClient, reading
from tests.sim_twin.wire.ur.stub_world import START_Q, ServedController

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HOST, OTHER = loopback(11), loopback(12)
DASHBOARD, PRIMARY, SECONDARY, SCRIPT, RTDE = 29999, 30001, 30002, 30003, 30004
START = np.array(START_Q)


@pytest.fixture(scope="module")
def shared() -> Iterator[ServedController]:
    with ServedController(HOST, unlock_after_s=0.0) as served:
        yield served


@pytest.fixture
def served(shared: ServedController) -> Iterator[ServedController]:
    """The controller, with its arm at the start, no faults and no program."""
    yield shared
    shared.push[:], shared.held = 0, False
    shared.inject()
    send(SCRIPT, "movej([{},{},{},{},{},{}], a=20, v=3)\n".format(*START_Q))
    wait_for(lambda: bool(np.abs(shared.q - START).max() < 1e-6))


def wait_for(condition: Callable[[], bool], limit: float = 10.0) -> None:
    end = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.01)


def send(port: int, text: str) -> None:
    with socket.create_connection((HOST, port), timeout=2) as connection:
        connection.sendall(text.encode())


def exactly(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise ConnectionError("closed")
        data += part
    return data


def stream_message(connection: socket.socket) -> tuple[int, bytes]:
    """The next message of a primary or secondary stream."""
    size, kind = struct.unpack(">iB", exactly(connection, 5))
    return kind, exactly(connection, size - 5)


class Dashboard:
    """A dashboard connection."""

    def __init__(self, host: str = HOST) -> None:
        self._socket = socket.create_connection((host, DASHBOARD), timeout=2)
        self._file = self._socket.makefile("rb")
        self.greeting = self.line()

    def __enter__(self) -> Dashboard:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._socket.close()

    def line(self) -> str:
        return self._file.readline().decode("latin-1").strip()

    def ask(self, line: str) -> str:
        self._socket.sendall(f"{line}\n".encode())
        return self.line()


def loop_client(host: str = HOST) -> tuple[RtdeClient, int, socket.socket]:
    """A client that runs the control loop, its recipe of one command and eleven numbers, and the script connection."""
    client = RtdeClient(host)
    client.negotiate()
    recipe, _ = client.inputs(["input_int_register_0", *(f"input_double_register_{i}" for i in range(11))])
    assert recipe == 1
    # Registers keep what was in them.
    client.write(recipe, 0, *[0.0] * 11)
    with reading(host, "input_int_register_0") as reader:
        wait_for(lambda: reader.newest()["input_int_register_0"] == 0)
    script = socket.create_connection((host, SCRIPT), timeout=2)
    script.sendall(CONTROL_SCRIPT)
    with reading(host, "runtime_state", "output_int_register_0") as reader:
        wait_for(lambda: list(reader.newest().values()) == [2, 1])
    return client, recipe, script


# RTDE


def test_every_variable_comes_in_one_stream(served: ServedController) -> None:
    names = list(OUTPUTS)
    with reading(HOST, *names[:200]) as one, reading(HOST, *names[200:]) as other:
        first, second = one.package(), other.package()
    assert [*first, *second] == names
    assert first["actual_q"] == pytest.approx(START_Q)
    assert first["robot_mode"] == 7


def test_the_time_goes_on_by_the_period(served: ServedController) -> None:
    with reading(HOST, "timestamp") as client:
        stamps = np.array([client.package()["timestamp"] for _ in range(200)])
    steps = np.diff(stamps) / 0.002
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    # A busy computer may hold the process up; what it leaves out shows in the stamps.
    assert np.median(steps) == pytest.approx(1.0)


def test_a_client_gets_the_frequency_it_asked_for(served: ServedController) -> None:
    with reading(HOST, "timestamp", frequency=125) as client:
        stamps = np.array([client.package()["timestamp"] for _ in range(20)])
    assert np.median(np.diff(stamps)) == pytest.approx(0.008)


def test_two_clients_cannot_write_the_same_input(served: ServedController) -> None:
    with RtdeClient(HOST) as one, RtdeClient(HOST) as other:
        one.negotiate()
        other.negotiate()
        assert one.inputs(["input_int_register_0"]) == (1, ["INT32"])
        assert other.inputs(["input_int_register_0", "input_int_register_1"]) == (0, ["IN_USE", "INT32"])
        one.close()
        wait_for(lambda: other.inputs(["input_int_register_0"])[0] == 1)


def test_a_client_that_never_reads_slows_nobody_and_gets_whole_packages(served: ServedController) -> None:
    names = [name for name in OUTPUTS if "register" not in name]
    with contextlib.closing(socket.socket()) as lazy, reading(HOST, "timestamp") as quick:
        lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        lazy.settimeout(2)
        lazy.connect((HOST, RTDE))
        request = struct.pack(">d", 500) + ",".join(names).encode()
        lazy.sendall(b"\x00\x05V\x00\x02" + struct.pack(">HB", 3 + len(request), ord("O")) + request + b"\x00\x03S")
        begin = quick.package()["timestamp"]
        for _ in range(500):
            last = quick.package()["timestamp"]
        kinds, stamps = [], []
        for _ in range(250):
            size, kind = struct.unpack(">HB", exactly(lazy, 3))
            payload = exactly(lazy, size - 3)
            kinds.append(chr(kind))
            if kind == ord("U"):
                stamps.append(struct.unpack_from(">d", payload, 1)[0])
    assert isinstance(begin, float)
    assert isinstance(last, float)
    assert kinds[:3] == ["V", "O", "S"]
    assert set(kinds[3:]) == {"U"}
    # Oldest first: there is a gap, and behind it comes what is newest.
    assert np.diff(stamps).max() > 0.1
    assert max(stamps) > last - 0.5


def test_half_a_message_and_garbage_hurt_only_who_sent_them(served: ServedController) -> None:
    with reading(HOST, "timestamp") as good:
        for data in (b"\x00", b"\x00\x10V", b"\x00\x01\x00", b"\xff" * 1000, b"GET / HTTP/1.1\r\n\r\n"):
            with socket.create_connection((HOST, RTDE), timeout=2) as bad:
                bad.sendall(data)
                good.package()
        with socket.create_connection((HOST, RTDE), timeout=2) as bad:
            bad.sendall(b"\x00\x02\x00")
            assert bad.recv(10) == b""
        good.newest()


def test_the_control_loop_is_driven_by_registers(served: ServedController) -> None:
    client, recipe, script = loop_client()
    with client, script, reading(HOST, "output_int_register_0", "runtime_state", "actual_q") as reader:
        client.write(recipe, 1, 0.3, *START_Q[1:], 2.0, 10.0, 0, 0, 0)
        wait_for(lambda: reader.newest()["output_int_register_0"] == 2)
        client.write(recipe, 0, *[0.0] * 11)
        wait_for(lambda: reader.newest()["output_int_register_0"] == 1)
        assert reader.newest()["actual_q"] == pytest.approx((0.3, *START_Q[1:]))
        client.write(recipe, 255, *[0.0] * 11)
        wait_for(lambda: reader.newest()["runtime_state"] == 1)


def test_a_motion_outlives_its_client_unless_there_is_a_watchdog(served: ServedController) -> None:
    for frequency, goes_on in ((0.0, True), (10.0, False)):
        client, recipe, script = loop_client()
        with client, script, reading(HOST, "output_int_register_0") as reader:
            client.write(recipe, 35, frequency, *[0.0] * 10)
            wait_for(lambda reader=reader: reader.newest()["output_int_register_0"] == 2)
            client.write(recipe, 9, 0.1, 0, 0, 0, 0, 0, 1.0, 0.004, 0, 0, 0)
            wait_for(lambda: bool(served.q[0] > 0.005))
        time.sleep(0.5)
        at = served.q
        time.sleep(0.2)
        assert (np.abs(served.q - at).max() > 0) == goes_on
        send(SCRIPT, "stopj(10)\n")


# Scripts and streams


def test_lines_of_script_move_the_arm_on_every_script_port(served: ServedController) -> None:
    for port, angle in ((SCRIPT, 0.1), (PRIMARY, 0.2), (SECONDARY, 0.3)):
        goal = (angle, *START_Q[1:])
        send(port, f"movej({list(goal)}, a=10, v=2)\n")
        wait_for(lambda goal=goal: bool(np.abs(served.q - goal).max() < 1e-9))


def test_the_tcp_counts_in_poses(served: ServedController) -> None:
    with reading(HOST, "actual_TCP_pose", "tcp_offset", "payload") as reader:
        send(SCRIPT, "def p():\n set_tcp(p[0,0,0.2,0,0,0])\n set_payload(1.1)\nend\n")
        wait_for(lambda: reader.newest()["payload"] == 1.1)
        expected = ur5e.forward(START)
        expected[:3, 3] += 0.2 * expected[:3, 2]
        assert reader.newest()["actual_TCP_pose"] == pytest.approx(matrix_to_pose(expected), abs=1e-6)
        assert served.command.read()["T_flange_tcp"][2, 3] == pytest.approx(0.2)
        assert served.command.read()["payload_kg"] == pytest.approx(1.1)
        send(SCRIPT, "set_tcp(p[0,0,0,0,0,0])\n")


@pytest.mark.parametrize("port", [PRIMARY, SECONDARY, SCRIPT])
def test_a_client_that_closes_without_reading_still_gets_its_program_run(served: ServedController, port: int) -> None:
    for number in range(10):
        with socket.create_connection((HOST, port), timeout=2) as client:
            # Something has come that nobody will ever read: closing the connection resets it.
            client.recv(1, socket.MSG_PEEK)
            client.sendall(f"write_output_integer_register(7, {number})\n".encode() * 2)
        with reading(HOST, "output_int_register_7") as reader:
            wait_for(lambda number=number: reader.newest()["output_int_register_7"] == number)


def test_a_dashboard_client_that_closes_at_once_is_obeyed(served: ServedController) -> None:
    send(SCRIPT, "def p():\n sleep(60)\nend\n")
    with Dashboard() as dashboard, socket.create_connection((HOST, DASHBOARD), timeout=2) as hasty:
        wait_for(lambda: dashboard.ask("programState") == "PLAYING p")
        hasty.recv(1, socket.MSG_PEEK)
        hasty.sendall(b"running\nstop\n")
        hasty.close()
        wait_for(lambda: dashboard.ask("programState") == "STOPPED null")


def messages(primary: socket.socket, *kinds: int) -> list[bytes]:
    """The next robot message of each kind, in this order, without its head."""
    found: list[bytes] = []
    end = time.monotonic() + 10
    for wanted in kinds:
        while True:
            assert time.monotonic() < end, f"no message of type {wanted} after {found}"
            kind, body = stream_message(primary)
            if kind == 20 and body[9] == wanted:
                assert body[8] == 0xFD
                found.append(body[10:])
                break
    return found


def test_a_program_that_is_not_understood_looks_failed_to_primary_clients(served: ServedController) -> None:
    with socket.create_connection((HOST, PRIMARY), timeout=2) as primary:
        send(SCRIPT, "def p():\n  write_output_integer_register(8, 1)\n  if True:\n  end\nend\n")
        exception, text = messages(primary, 10, 0)
        assert struct.unpack_from(">ii", exception) == (3, 1)
        assert exception[8:] == b"syntax_error_on_line:3:if True::"
        assert b"line 3" in text
        send(SCRIPT, "def p():\n  movej([9,0,0,0,0,0])\nend\n")
        started, exception, stopped = messages(primary, 7, 10, 7)
        assert started[9:] == b"PROGRAM_XXX_STARTEDp"
        assert struct.unpack_from(">ii", exception) == (2, 1)
        assert b"joint limits" in exception
        assert stopped[9:] == b"PROGRAM_XXX_STOPPEDp"
        send(SCRIPT, "sec s():\n  fly()\nend\n")
        [exception] = messages(primary, 10)
        assert exception[8:] == b"SECONDARY_PROGRAM_EXCEPTION_XXXcompile_error_name_not_found:fly:"
    with reading(HOST, "output_int_register_8") as reader:
        assert reader.newest()["output_int_register_8"] == 0


def test_a_protective_stop_is_told_with_its_code_and_left_by_a_line_of_script(served: ServedController) -> None:
    with socket.create_connection((HOST, PRIMARY), timeout=2) as primary:
        primary.recv(1, socket.MSG_PEEK)
        served.push[:] = [0, 0, 200]
        error, mode = messages(primary, 6, 5)
        assert struct.unpack_from(">iiiII", error) == (157, -1, 3, 0, 0)
        assert b"200 N" in error
        assert struct.unpack(">iiBII", mode) == (157, -1, 3, 0, 0)
        served.push[:] = 0
        time.sleep(0.05)
        primary.sendall(b"set unlock protective stop\n")
        [mode] = messages(primary, 5)
        assert struct.unpack(">iiBII", mode) == (0, 0, 1, 0, 0)


def test_lines_of_script_power_the_arm(served: ServedController) -> None:
    with socket.create_connection((HOST, PRIMARY), timeout=2) as primary, Dashboard() as dashboard:
        for line, state in (("power off", "POWER_OFF"), ("power on", "IDLE"), ("set robotmode run", "RUNNING")):
            primary.sendall(f"{line}\n".encode())
            wait_for(lambda state=state: dashboard.ask("robotmode") == f"Robotmode: {state}")


def test_a_program_that_takes_long_to_read_holds_up_nobody(served: ServedController) -> None:
    # The world of a served arm without real-time priority may hold it up too, but never for so long.
    longest_s = 1.0
    text = b"def p():\n# inject move path\n" + b"\n" * 80_000 + b"# RTDE Control script - Main loop\nend\n"
    with socket.create_connection((HOST, PRIMARY), timeout=20) as primary, reading(HOST, "timestamp") as good:
        good.settimeout(60)
        stamps = [good.package()["timestamp"]]
        primary.sendall(text)
        for _ in range(500):
            stamps.append(good.package()["timestamp"])
        [exception] = messages(primary, 10)
    assert b"20000 lines" in exception
    assert np.diff(stamps).max() < longest_s


# Many clients


@pytest.mark.parametrize("port", [DASHBOARD, SECONDARY, SCRIPT, RTDE])
def test_silent_clients_give_way_to_new_ones(served: ServedController, port: int) -> None:
    with contextlib.ExitStack() as stack, reading(HOST, "timestamp") as streaming, Dashboard() as talking:
        talking.ask("running")
        for _ in range(40):
            stack.enter_context(socket.create_connection((HOST, port), timeout=2))
        with socket.create_connection((HOST, port), timeout=2) as client:
            if port == RTDE:
                client.sendall(b"\x00\x03v")
            assert client.recv(1)
        # Neither one that listens to its packages nor one that has spoken is taken for silent.
        streaming.newest()
        assert talking.ask("running") == "Program running: false"


def test_a_port_that_is_full_of_streams_takes_nobody_else(served: ServedController) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(reading(HOST, "timestamp", frequency=10)) for _ in range(32)]
        with socket.create_connection((HOST, RTDE), timeout=2) as client, contextlib.suppress(ConnectionResetError):
            assert client.recv(1) == b""
        for client in clients:
            client.package()


@pytest.mark.parametrize("port", [PRIMARY, SECONDARY, 30011, 30012])
def test_the_state_streams_begin_with_the_version(served: ServedController, port: int) -> None:
    with contextlib.ExitStack() as stack:
        # Several at once.
        clients = [stack.enter_context(socket.create_connection((HOST, port), timeout=2)) for _ in range(3)]
        for client in clients:
            kind, body = stream_message(client)
            assert (kind, body[9]) == (20, 3)
            length = body[10]
            assert body[11 : 11 + length] == b"URControl"
            assert struct.unpack_from(">BB", body, 11 + length) == (5, 12)
            state = {}
            while kind != 16:
                kind, body = stream_message(client)
            while body:
                size, part = struct.unpack_from(">iB", body)
                state[part], body = body[5:size], body[size:]
            # Universal Robots, client interfaces 5.10: bytes of the sub packages without their heads.
            sizes = {0: 42, 1: 246, 2: 32, 3: 70, 4: 96, 5: 220, 6: 440, 7: 56, 8: 4, 11: 21, 12: 3, 13: 2}
            assert {part: len(data) for part, data in state.items()} == sizes
            joints = [struct.unpack_from(">3d", state[1], 41 * i)[0] for i in range(6)]
            assert joints == pytest.approx(START_Q)
            assert state[0][15] == 7
            assert struct.unpack_from(">I", state[5], 216) == (2,), "calibrated"
            pose = struct.unpack_from(">6d", state[4])
            assert pose == pytest.approx(matrix_to_pose(ur5e.forward(START)), abs=1e-6)


def test_the_realtime_stream_has_its_layout(served: ServedController) -> None:
    with socket.create_connection((HOST, SCRIPT), timeout=2) as client:
        packets = [exactly(client, 1220) for _ in range(5)]
    for packet in packets:
        (size,) = struct.unpack_from(">i", packet)
        numbers = struct.unpack_from(">152d", packet, 4)
        assert size == 1220
        assert numbers[1:7] == pytest.approx(START_Q)
        assert numbers[31:37] == pytest.approx(START_Q)
        assert numbers[94] == 7
        assert numbers[131] == 1
    times = [struct.unpack_from(">d", packet, 4)[0] for packet in packets]
    assert times == sorted(set(times))


# Safety


def test_two_cells_move_at_once_and_a_push_stops_only_the_one_that_is_pushed(served: ServedController) -> None:
    with ServedController(OTHER) as other, contextlib.ExitStack() as stack:
        for host, angle in ((HOST, 0.2), (OTHER, -0.2)):
            client, recipe, script = loop_client(host)
            stack.enter_context(client)
            stack.enter_context(script)
            client.write(recipe, 1, angle, *START_Q[1:], 2.0, 10.0, 0, 0, 0)
        wait_for(lambda: bool(abs(served.q[0] - 0.2) < 1e-9 and abs(other.q[0] + 0.2) < 1e-9))
        names = ("safety_mode", "runtime_state")
        here, there = (stack.enter_context(reading(host, *names)) for host in (HOST, OTHER))
        other.push[:] = [0, 0, 200]
        wait_for(lambda: list(there.newest().values()) == [3, 4])
        assert list(here.newest().values()) == [1, 2]
        other.push[:] = 0
        assert stack.enter_context(Dashboard(OTHER)).ask("unlock protective stop").startswith("Cannot unlock")


# Faults of the links


def fault(channel: str, kind: Kind, what: str = "", value: float | None = None) -> Fault:
    return Fault("arm", channel, kind, what, value)


@pytest.mark.parametrize(("channel", "port"), [("rtde", RTDE), ("dashboard", DASHBOARD), ("script", SCRIPT)])
def test_a_link_that_is_off_is_closed_and_comes_back(served: ServedController, channel: str, port: int) -> None:
    with socket.create_connection((HOST, port), timeout=2) as client:
        served.inject(fault(channel, Kind.OFF))
        with contextlib.suppress(ConnectionResetError):
            while client.recv(65536):
                pass
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((HOST, port), timeout=2)
    served.inject()
    socket.create_connection((HOST, port), timeout=2).close()


@pytest.mark.parametrize(("channel", "port"), [("rtde", RTDE), ("dashboard", DASHBOARD)])
def test_a_stuck_link_accepts_and_says_nothing(served: ServedController, channel: str, port: int) -> None:
    served.inject(fault(channel, Kind.STUCK))
    with socket.create_connection((HOST, port), timeout=0.3) as client:
        client.sendall(b"\x00\x03v" if channel == "rtde" else b"robotmode\n")
        with pytest.raises(TimeoutError):
            client.recv(100)
        served.inject()
        client.settimeout(2)
        assert client.recv(100)


def test_a_stream_that_sticks_goes_on_afterwards(served: ServedController) -> None:
    with reading(HOST, "timestamp") as client:
        client.settimeout(0.3)
        served.inject(fault("rtde", Kind.STUCK))
        with pytest.raises(TimeoutError):
            _read_on(client)
        served.inject()
        client.package()


@pytest.mark.parametrize(("what", "header"), [("", b"\x00\x01\xff"), ("zero_length", b"\x00\x03U")])
def test_garbage_on_rtde(served: ServedController, what: str, header: bytes) -> None:
    served.inject(fault("rtde", Kind.GARBAGE, what))
    with socket.create_connection((HOST, RTDE), timeout=2) as client:
        client.sendall(b"\x00\x03v")
        assert exactly(client, 3) == header


def test_garbage_on_the_dashboard(served: ServedController) -> None:
    served.inject(fault("dashboard", Kind.GARBAGE))
    with Dashboard() as dashboard:
        assert "Robotmode" not in dashboard.ask("robotmode")


def test_a_slow_stream(served: ServedController) -> None:
    for share in (0.1, 0.3):
        served.inject(fault("rtde", Kind.SLOW, value=share))
        with reading(HOST, "timestamp") as client:
            stamps = np.array([client.package()["timestamp"] for _ in range(10)])
        assert np.median(np.diff(stamps)) == pytest.approx(round(1 / share) * 0.002)


def test_delayed_packages_are_late_but_whole(served: ServedController) -> None:
    served.inject(fault("rtde", Kind.DELAYED, value=0.3))
    begin = time.monotonic()
    with reading(HOST, "timestamp") as client:
        # Version, outputs, and start with the first package: three times 0.3 s.
        first = client.package()["timestamp"]
        assert time.monotonic() - begin >= 0.9
        assert client.package()["timestamp"] == pytest.approx(float(first) + 0.002)  # type: ignore[arg-type]


def test_an_intermittent_link_goes_and_comes(served: ServedController) -> None:
    served.inject(fault("rtde", Kind.INTERMITTENT, value=0.2))
    seen = set()
    end = time.monotonic() + 5
    while seen != {True, False}:
        assert time.monotonic() < end
        try:
            socket.create_connection((HOST, RTDE), timeout=1).close()
            seen.add(True)
        except ConnectionRefusedError:
            seen.add(False)
        time.sleep(0.05)


def test_wrong_answers_on_rtde(served: ServedController) -> None:
    served.inject(fault("rtde", Kind.WRONG, "version"))
    with RtdeClient(HOST) as client:
        assert not client.negotiate()
    served.inject(fault("rtde", Kind.WRONG, "in_use"), fault("rtde", Kind.WRONG, "not_found"))
    with RtdeClient(HOST) as client:
        client.negotiate()
        assert client.inputs(["input_int_register_0"]) == (0, ["IN_USE"])
        assert client.outputs(["timestamp", "actual_q"]) == ["DOUBLE", "NOT_FOUND"]


def test_a_late_dashboard(served: ServedController) -> None:
    with Dashboard() as dashboard:
        served.inject(fault("dashboard", Kind.DELAYED, value=0.4))
        begin = time.monotonic()
        assert dashboard.ask("running") == "Program running: false"
        assert time.monotonic() - begin >= 0.4


# Beginning and end


def _read_on(client: RtdeClient) -> None:
    while True:
        client.package()


def test_a_port_that_is_taken_is_named() -> None:
    with contextlib.closing(socket.socket()) as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind((loopback(13), 30003))
        taken.listen()
        with ServedController(loopback(13)) as served:
            assert f"port 30003 of {loopback(13)} (script of the arm) cannot be opened" in served.endpoints["error"]


def test_sigterm_ends_it_with_clients_connected() -> None:
    with ServedController(loopback(13)) as served, reading(loopback(13), "timestamp") as client:
        client.package()
        os.kill(served.process.pid or 0, signal.SIGINT)
        time.sleep(0.1)
        client.package()
        os.kill(served.process.pid or 0, signal.SIGTERM)
        served.process.join(5)
        assert served.process.exitcode == 0
        with pytest.raises(ConnectionError):
            _read_on(client)


def test_a_client_that_floods_its_connection_does_not_hold_up_the_period(served: ServedController) -> None:
    with reading(HOST, "timestamp") as good, contextlib.closing(socket.create_connection((HOST, RTDE))) as flood:
        flood.setblocking(False)
        begin = time.monotonic()
        count = 0
        while time.monotonic() < begin + 1.0:
            with contextlib.suppress(BlockingIOError):
                flood.send(b"\x00\x03M" * 10_000)
            good.package()
            count += 1
    assert count > 100
