"""`robotcell twin` as a person starts it."""

import os
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest
from pymodbus.client import ModbusTcpClient
from typer.testing import CliRunner

from cli.main import app
from tests.addresses import loopback
from tests.processes import all_end

LIMIT_S = 120.0
COMMAND = [sys.executable, "-c", "from cli.main import main; main()", "twin"]
PORTS = ["--modbus-port", "0", "--camera-port", "0", "--control-port", "0"]


class Serving:
    """The command in a process of its own, and the addresses that it prints."""

    def __init__(self, host):
        self.process = subprocess.Popen(
            [*COMMAND, "serve", "--host", host, "--objects", "1", "--seed", "3", *PORTS],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.lines = []
        while not self.lines or "control socket" not in self.lines[-1]:
            line = self.process.stdout.readline()
            assert line, self.process.stderr.read()
            self.lines.append(line)
        self.servers = [child.pid for child in psutil.Process(self.process.pid).children(recursive=True)]

    def address(self, word):
        return next(line.split()[-1] for line in self.lines if word in line)

    def end(self, number, times=1):
        for _ in range(times):
            os.kill(self.process.pid, number)
        _, errors = self.process.communicate(timeout=LIMIT_S)
        return self.process.returncode, errors


@pytest.fixture(scope="module")
def serving():
    serving = Serving(loopback(29))
    yield serving
    # The last test that needs it has ended it, unless that one was left out or failed.
    if serving.process.poll() is None:
        serving.end(signal.SIGTERM)


def run(*words):
    result = CliRunner().invoke(app, ["twin", *map(str, words)])
    return result.exit_code, result.output


def test_says_what_to_connect_where(serving):
    for word in ("RTDE", "dashboard", "Modbus TCP", f"twin://{loopback(29)}:", "control socket"):
        host, port = serving.address(word).rsplit(":", 1)
        with socket.create_connection((host, int(port)), timeout=5):
            pass


def test_gives_and_takes_faults(serving):
    control = serving.address("control socket")
    host, port = serving.address("Modbus TCP").rsplit(":", 1)
    assert run("fault", "--control", control, "gripper", "modbus", "wrong", "exception", "--value", 4) == (0, "")
    code, output = run("fault", "--control", control, "--list")
    assert code == 0
    assert "on: gripper modbus wrong exception 4.0" in output
    client = ModbusTcpClient(host, port=int(port), timeout=1, retries=0)
    assert client.connect()
    assert client.read_holding_registers(1536, count=1, device_id=65).exception_code == 4
    assert run("fault", "--control", control, "--clear") == (0, "")
    time.sleep(0.2)
    assert client.read_holding_registers(1536, count=1, device_id=65).registers == [0x20]
    client.close()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["gripper", "modbus", "slow"], 2, "modbus delayed"),
        (["gripper", "modbus", "asleep"], 2, "intermittent"),
        (["gripper", "modbus"], 2, "DEVICE CHANNEL KIND"),
        ([], 2, "DEVICE CHANNEL KIND"),
    ],
)
def test_a_fault_that_does_not_exist_is_told_from_those_that_do(serving, words, code, said):
    got, output = run("fault", "--control", serving.address("control socket"), *words)
    assert got == code
    assert said in output


@pytest.mark.parametrize(
    ("control", "code"), [(f"{loopback(29)}:1", 3), (loopback(29), 2)], ids=["nobody there", "no port"]
)
def test_no_control_socket(control, code):
    assert run("fault", "--control", control, "--list")[0] == code


def test_signals_that_come_in_pairs_end_it_clean(serving):
    assert serving.end(signal.SIGTERM, times=5) == (0, "")
    assert all_end(serving.servers)


def test_an_interrupt_ends_it_clean():
    serving = Serving(loopback(22))
    assert serving.end(signal.SIGINT) == (0, "")
    assert all_end(serving.servers)


def test_an_interrupt_while_it_starts_ends_it_clean_too():
    command = [*COMMAND, "serve", "--host", loopback(22), "--objects", "1", *PORTS]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        children: list[psutil.Process] = []
        end = time.monotonic() + LIMIT_S
        # The first of them keeps the shared memory.
        while len(children) < 3 and time.monotonic() < end:
            children = psutil.Process(process.pid).children()
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=LIMIT_S)
        assert errors == ""
    assert process.returncode == 0
    assert all_end(child.pid for child in children)


def test_refuses_to_be_reached_by_others_unless_told():
    code, output = run("serve", "--host", "0.0.0.0")
    assert code == 2
    assert "--expose" in output


def test_a_wrong_scene_is_said_before_anything_starts():
    code, output = run("serve", "--host", loopback(22), "--objects", 99)
    assert code == 2
    assert "--objects 99: Input should be" in output


def test_settings_of_the_cell_are_taken():
    code, output = run("serve", "--host", loopback(22), "--set", "table.height_m=nonsense")
    assert code == 2
    assert "--set table.height_m" in output
