"""A controller that is not there, silent, or something else: an error with words, in bounded time."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from robotcell.drivers.clock import WallClock
from robotcell.drivers.ur5e.arm import UR5e, UR5eOptions
from robotcell.drivers.ur5e.controller import Controller, arm_mode, inspect, obstacles
from robotcell.drivers.ur5e.controller_findings import controller_findings, tool_findings
from robotcell.errors import ConnectionLost
from robotcell.findings import Grade
from robotcell.interfaces import ArmMode
from tests.addresses import loopback

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HOST = loopback(41)
PORTS = (30004, 30003, 29999)
READY = Controller(
    version=(5, 12, 6, 1),
    model="UR5",
    serial="20225500001",
    remote=True,
    robot_mode=7,
    safety_mode=1,
    runtime_state=1,
    speed_fraction=1.0,
    payload_kg=0.78,
    payload_cog=(0.0, 0.0, 0.064),
    tcp_offset=(0.0, 0.0, 0.213, 0.0, 0.0, 0.0),
)


@contextmanager
def listening(port: int, answer: Callable[[socket.socket], None]) -> Iterator[None]:
    """A server that treats each connection by `answer`."""
    with socket.create_server((HOST, port)) as server, ExitStack() as clients:
        server.settimeout(0.05)
        done = threading.Event()

        def serve() -> None:
            while not done.is_set():
                try:
                    client, _ = server.accept()
                except TimeoutError:
                    continue
                clients.enter_context(client)
                answer(client)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def say(data: bytes) -> Callable[[socket.socket], None]:
    def answer(client: socket.socket) -> None:
        client.sendall(data)

    return answer


def trickle(client: socket.socket) -> None:
    """One byte now and then, for ever."""
    client.sendall(b"\x40\x00\x56")
    with suppress(OSError):  # the driver has left
        for _ in range(20):
            time.sleep(0.1)
            client.sendall(b"\x00")


def refused(seconds: float, words: str) -> None:
    """The driver refuses with these words within a bound."""
    begin = time.monotonic()
    with pytest.raises(ConnectionLost, match=words) as lost:
        UR5e(UR5eOptions(host=HOST), WallClock()).connect()
    assert lost.value.device == "arm"
    assert time.monotonic() - begin < seconds


def test_says_that_nothing_is_there() -> None:
    refused(1.0, "30004.*refused.*check that the controller has booted")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "sent nothing for 1 s"),
        (b"\x00\x00\x00", "not RTDE"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n" + bytes(0x4854), "message of kind"),
        (b"\x00\x04\x56\x00", "version 2"),
        (b"\x00\x04\x56\x01" + b"\x00\x05\x76\x00\x00", "four numbers"),
    ],
)
def test_says_what_does_not_speak_rtde(data: bytes, words: str) -> None:
    with listening(30004, say(data)):
        refused(2.0, words)


def test_a_server_that_trickles_does_not_hold_it() -> None:
    with listening(30004, trickle):
        refused(2.5, "sent no(thing| whole message) for 1 s")


def test_a_host_that_drops_connections_does_not_hold_it() -> None:
    # A listener that accepts nobody: the first connection fills its queue, the next one is left to wait.
    with socket.socket() as server, ExitStack() as waiting:
        server.bind((HOST, 30004))
        server.listen(0)
        for _ in range(3):
            client = waiting.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex((HOST, 30004))
        refused(2.5, "timed out|sent nothing")


def test_lists_everything_that_keeps_an_arm_from_being_driven() -> None:
    assert obstacles(READY) == []
    troubled = replace(READY, version=(3, 15, 8, 1), model="UR10", remote=False, robot_mode=3, speed_fraction=0.0)
    words = "\n".join(obstacles(troubled))
    for part in ("PolyScope 3.15", "UR10", "Remote Control", "powered off", "slider is at 0 %"):
        assert part in words
    assert len(obstacles(troubled)) == 5
    assert "enable Settings > System > Remote Control" in words
    assert "release the button" in obstacles(replace(READY, safety_mode=7))[0]


@pytest.mark.parametrize("fraction", [0.0, 0.02, float("nan")])
def test_a_slider_at_almost_nothing_is_in_the_way(fraction: float) -> None:
    assert len(obstacles(replace(READY, speed_fraction=fraction))) == 1


@pytest.mark.parametrize(
    ("robot_mode", "safety_mode", "ready", "mode"),
    [
        (7, 1, True, ArmMode.READY),
        (7, 2, True, ArmMode.READY),
        (7, 1, False, ArmMode.NOT_READY),
        (7, 3, True, ArmMode.PROTECTIVE_STOP),
        (3, 7, False, ArmMode.EMERGENCY_STOP),
        (7, 5, True, ArmMode.NOT_READY),
        (5, 1, True, ArmMode.NOT_READY),
        (7, 9, True, ArmMode.NOT_READY),
        (7, 12, True, ArmMode.NOT_READY),
    ],
)
def test_the_mode_is_ready_only_when_everything_is(
    robot_mode: int, safety_mode: int, ready: bool, mode: ArmMode
) -> None:
    assert arm_mode(robot_mode, safety_mode, ready=ready) is mode


def test_inspection_needs_every_port() -> None:
    with pytest.raises(ConnectionLost, match="30004"):
        inspect(HOST)


def test_a_tool_that_somebody_changed_is_wrong_and_one_that_is_yet_to_be_set_is_noted() -> None:
    changed = replace(READY, payload_kg=2.0, tcp_offset=(0.0, 0.0, 0.15, 0.0, 0.0, 0.0))
    for set_by_us, grade in ((True, Grade.WRONG), (False, Grade.NOTE)):
        found = list(tool_findings(changed, READY.payload_kg, READY.payload_cog, changed=set_by_us))
        assert {finding.what: finding.grade for finding in found} == {
            "TCP [m, rad]": grade,
            "payload [kg]": grade,
            "payload's centre [m]": Grade.OK,
        }
        assert all(("0.78" in finding.cure) == (finding.what == "payload [kg]") for finding in found)


def test_a_slow_slider_is_noted_and_one_that_stands_still_is_wrong() -> None:
    def grades(fraction: float) -> set[Grade]:
        return {finding.grade for finding in controller_findings(replace(READY, speed_fraction=fraction))}

    assert grades(1.0) == {Grade.OK}
    assert grades(0.5) == {Grade.OK, Grade.NOTE}
    assert Grade.WRONG in grades(0.01)
