import os
import signal
import socket
import subprocess
import sys
import time
from multiprocessing.shared_memory import SharedMemory

import pytest
from pymodbus.client import ModbusTcpClient

from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.wire.cell import ServedCell
from sim_twin.wire.faults import Fault, Kind
from tests.addresses import loopback
from tests.processes import all_end
from tests.sim_twin.wire.conftest import HOST, ONE

LIMIT_S = 30.0
# A supervisor as the command line is one, in a process of its own.
SUPERVISOR = """
import sys
from robotcell.config import load_config
from sim_twin.wire.cell import ServedCell
if __name__ == "__main__":
    with ServedCell(load_config(None, {"backend.options.objects": 1}), "HOST", 0, 0) as cell:
        print(*cell.processes.values(), flush=True)
        sys.stdin.read()
"""


def test_every_server_is_there_and_says_where(served):
    assert set(served.processes) == {"world", "ur", "compute box", "camera"}
    assert {"rtde", "dashboard", "modbus", "camera"} <= set(served.endpoints)
    assert all(address.startswith(f"{HOST}:") for address in served.endpoints.values())
    assert served.ended == []


def test_the_world_and_the_controller_live(served):
    state, command = served.state(), served.command()
    end = time.monotonic() + LIMIT_S
    while served.state()["t"] <= state["t"] or served.command()["tick"] <= command["tick"]:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_stop_directly_followed_by_a_grip_moves_the_fingers(served):
    """As a common ROS 2 driver writes it: back to back on one connection."""
    host, _, port = served.endpoints["modbus"].rpartition(":")
    with ModbusTcpClient(host, port=int(port), timeout=LIMIT_S, retries=0) as client:
        client.write_register(0, 200, device_id=65)
        for width in (300, 700, 400, 800):
            # The first grip is under way when the stop comes.
            client.write_registers(1, [1000, 16], device_id=65)
            for register, value in ((2, 8), (1, width), (2, 16)):
                assert not client.write_register(register, value, device_id=65).isError()
            end = time.monotonic() + LIMIT_S
            while abs(client.read_holding_registers(267, count=1, device_id=65).registers[0] - width) > 5:
                assert time.monotonic() < end, f"the grip to {width} was lost"
                time.sleep(0.02)


def test_a_port_that_is_taken_is_named():
    host = loopback(28)
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


def test_a_cell_that_is_not_served_has_no_state():
    with pytest.raises(ConnectionLost):
        ServedCell(ONE, HOST).state()


def test_a_server_that_was_killed_is_missed_and_leaves_nothing():
    cell = ServedCell(ONE, loopback(25), modbus_port=0, camera_port=0)
    with cell:
        names = cell.shared_memory
        assert len(names) == 4
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
    script.write_text(SUPERVISOR.replace("HOST", loopback(24)), encoding="utf-8")
    supervisor = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    with supervisor:
        pids = [int(pid) for pid in supervisor.stdout.readline().split()]
        assert len(pids) == 4
        supervisor.kill()
    assert all_end(pids)
