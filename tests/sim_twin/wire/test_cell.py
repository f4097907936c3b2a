import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from multiprocessing.shared_memory import SharedMemory

import pytest

from robotcell.config import load_config
from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.wire.cell import ServedCell, is_loopback
from sim_twin.wire.faults import Fault, Kind
from tests.processes import all_end

HOST = "127.0.0.23"
ONE = load_config(None, {"backend.options.objects": 1})
LIMIT_S = 30.0
# A supervisor as the command line is one, in a process of its own.
SUPERVISOR = """
import sys
from robotcell.config import load_config
from sim_twin.wire.serve import ServedCell
if __name__ == "__main__":
    with ServedCell(load_config(None, {"backend.options.objects": 1}), "127.0.0.24", 0, 0) as cell:
        print(*cell.processes.values(), flush=True)
        sys.stdin.read()
"""


@pytest.fixture(scope="module")
def served():
    with ServedCell(ONE, HOST, modbus_port=0, camera_port=0, control_port=0) as cell:
        yield cell


@pytest.fixture(autouse=True)
def no_faults(served):
    yield
    served.clear()


def ask(cell, line):
    host, _, port = cell.endpoints["control"].rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as link, link.makefile("rw") as lines:
        lines.write((line if isinstance(line, str) else json.dumps(line)) + "\n")
        lines.flush()
        return json.loads(lines.readline())


def test_every_server_is_there_and_says_where(served):
    assert set(served.processes) == {"world", "ur", "box", "camera"}
    assert {"rtde", "dashboard", "modbus", "camera", "control"} <= set(served.endpoints)
    assert all(address.startswith(f"{HOST}:") for address in served.endpoints.values())
    assert served.ended == []


def test_the_world_and_the_controller_live(served):
    state, command = served.state(), served.command()
    end = time.monotonic() + LIMIT_S
    while served.state()["t"] <= state["t"] or served.command()["tick"] <= command["tick"]:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_port_that_is_taken_is_named():
    host = "127.0.0.28"
    with socket.create_server((host, 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"{host}:{port}"):
            ServedCell(ONE, host, modbus_port=port, camera_port=0).start()


def test_only_a_twin_can_be_served():
    config = ONE.model_copy(update={"backend": ONE.backend.model_copy(update={"name": "hardware"})})
    with pytest.raises(ConfigError, match="hardware"):
        ServedCell(config, HOST).start()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault("gripper", "modbus", Kind.SLOW), "modbus delayed"),
        (Fault("gripper", "mudbus", Kind.OFF), "mudbus off"),
        (Fault("gripper", "modbus", Kind.WRONG), "modbus wrong unit"),
        (Fault("gripper", "modbus", Kind.DELAYED, value=-1), "above 0"),
    ],
)
def test_a_fault_that_does_not_exist_is_refused_with_those_that_do(served, fault, words):
    with pytest.raises(ConfigError, match=words):
        served.inject(fault)
    assert served.faults == ()


def test_a_fault_replaces_the_one_like_it(served):
    for value in (0.1, 0.2):
        served.inject(Fault("gripper", "modbus", Kind.DELAYED, value=value))
    served.inject(Fault("gripper", "state", Kind.STUCK))
    assert [(fault.kind, fault.value) for fault in served.faults] == [(Kind.DELAYED, 0.2), (Kind.STUCK, None)]


def test_the_control_socket_obeys(served):
    fault = {"device": "gripper", "channel": "modbus", "kind": "delayed", "value": 0.3}
    assert ask(served, {"inject": fault}) == {"ok": True}
    answer = ask(served, {"list": True})
    assert answer["active"] == [{**fault, "what": ""}]
    assert "modbus wrong unit" in answer["exist"]["gripper"]
    assert ask(served, {"clear": True}) == {"ok": True}
    assert served.faults == ()
    assert ask(served, {"state": True})["state"]["width_m"] == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("nonsense", "not a line of JSON"),
        ("[]", "inject"),
        ("{}", "inject"),
        ({"explode": True}, "inject"),
        ({"clear": False}, "inject"),
        ({"inject": 3}, "not a fault"),
        ({"inject": {"device": "gripper", "channel": "modbus"}}, "kind"),
        ({"inject": {"device": "oven", "channel": "modbus", "kind": "off"}}, "device"),
        ({"inject": {"device": "gripper", "channel": "modbus", "kind": "off", "colour": 1}}, "colour"),
        ({"inject": {"device": "gripper", "channel": "modbus", "kind": "slow"}}, "there are"),
    ],
)
def test_the_control_socket_says_what_is_wrong(served, line, words):
    answer = ask(served, line)
    assert not answer["ok"]
    assert words in answer["error"]


def test_the_control_socket_hangs_up_on_a_flood_and_lives_on(served):
    host, _, port = served.endpoints["control"].rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as link:
        link.sendall(b"x" * 20_000)
        with contextlib.suppress(ConnectionResetError):
            assert link.recv(1) == b""
    assert ask(served, {"list": True})["ok"]


@pytest.mark.parametrize(("host", "only_here"), [("127.0.0.2", True), ("localhost", True), ("0.0.0.0", False)])
def test_which_addresses_only_this_machine_reaches(host, only_here):
    assert is_loopback(host) is only_here


def test_a_cell_that_is_not_served_has_no_state():
    with pytest.raises(ConnectionLost):
        ServedCell(ONE, HOST).state()


def test_a_server_that_was_killed_is_missed_and_leaves_nothing():
    cell = ServedCell(ONE, "127.0.0.25", modbus_port=0, camera_port=0)
    with cell:
        names = [cell._poses, *(record.name for record in cell._records)]
        os.kill(cell.processes["world"], signal.SIGKILL)
        end = time.monotonic() + LIMIT_S
        while cell.ended != ["world"]:
            assert time.monotonic() < end
            time.sleep(0.01)
        cell.inject(Fault("gripper", "modbus", Kind.OFF))
    cell.close()
    for name in names:
        with pytest.raises(FileNotFoundError):
            SharedMemory(name)


def test_no_server_outlives_a_supervisor_that_was_killed(tmp_path):
    script = tmp_path / "supervisor.py"
    script.write_text(SUPERVISOR, encoding="utf-8")
    supervisor = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    with supervisor:
        pids = [int(pid) for pid in supervisor.stdout.readline().split()]
        assert len(pids) == 4
        supervisor.kill()
    assert all_end(pids)
