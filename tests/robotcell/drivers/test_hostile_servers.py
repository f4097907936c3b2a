"""Whatever comes from the other end of a wire, a driver says what is wrong. It neither hangs nor hoards."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robotcell.drivers.rg2.compute_box import ComputeBox
from robotcell.drivers.ur5e import dashboard, rtde
from robotcell.errors import ConnectionLost, DeviceFault
from sim_twin.wire.d415.software_device import open_source
from sim_twin.wire.d415.stream import Description, encode
from tests.robotcell.drivers.hostile_server import HostileServer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HOST = "127.0.0.38"
FEW = settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])


def ask_rtde(_: int) -> None:
    with rtde.open_rtde(HOST) as reader:
        reader.claim_inputs(["input_int_register_0"])
        reader.start(["timestamp", "actual_q"], 125)
        reader.read()


def ask_dashboard(_: int) -> None:
    board = dashboard.Dashboard(HOST)
    try:
        board.connect()
        for _ in range(3):
            board.ask("robotmode")
    finally:
        board.close()


def ask_box(port: int) -> None:
    box = ComputeBox(HOST, port, 65, 0.2)
    try:
        box.open()
        box.state()
    finally:
        box.close()


def ask_camera(port: int) -> None:
    open_source(f"{HOST}:{port}", "640x480").close()


def message(kind: int, payload: bytes = b"") -> bytes:
    return struct.pack(">HB", 3 + len(payload), kind) + payload


CAMERA = encode(
    Description(
        name="x", serial="1", firmware="5.15.1.55", usb_type="3.2", frames_per_s=30, depth_unit_m=0.001, width=640,
        height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0,
    )
)  # fmt: skip
# Whole messages that a real device might send, so that noise gets past the first check.
WIRES: dict[str, tuple[Callable[[int], None], int, list[bytes]]] = {
    "rtde": (
        ask_rtde,
        rtde.PORT,
        [
            message(86, b"\x01"),
            message(118, struct.pack(">4I", 5, 12, 0, 1)),
            message(73, b"\x01INT32"),
            message(79, b"\x01DOUBLE,VECTOR6D"),
            message(83, b"\x01"),
            message(85, b"\x01" + bytes(56)),
            message(77, b"text"),
        ],
    ),
    "dashboard": (ask_dashboard, dashboard.PORT, [b"Connected: Universal Robots Dashboard Server\n", b"Robotmode: \n"]),
    "modbus": (
        ask_box,
        0,
        [struct.pack(">HHHBBB", 1, 0, 39, 65, 3, 36), bytes(36), struct.pack(">HHHBBB", 1, 0, 3, 65, 0x83, 2)],
    ),
    "camera": (ask_camera, 0, [CAMERA, struct.pack("!4sBI", b"D415", 3, 38), bytes(38)]),
}  # fmt: skip


@pytest.fixture(params=list(WIRES))
def wire(request: pytest.FixtureRequest) -> Iterator[tuple[Callable[[], None], HostileServer, list[bytes]]]:
    ask, port, likely = WIRES[request.param]
    with HostileServer(HOST, port) as server:
        yield lambda: ask(server.port), server, likely


def tolerated(ask: Callable[[], None]) -> None:
    """Ask; what is wrong is said in the cell's words."""
    try:
        ask()
    except (ConnectionLost, DeviceFault) as error:
        assert str(error)


@FEW
@given(data=st.data())
def test_noise_and_what_is_cut_off(
    wire: tuple[Callable[[], None], HostileServer, list[bytes]], data: st.DataObject
) -> None:
    ask, server, likely = wire
    parts = data.draw(st.lists(st.one_of(st.sampled_from(likely), st.binary(max_size=80)), max_size=8))
    stream = b"".join(parts)
    server.talk, server.endless = stream[: data.draw(st.integers(0, len(stream)))], False
    tolerated(ask)


@pytest.mark.parametrize("flood", [b"x" * 4096, b"\x00\x03M" * 1000, b"\x00\x01\x00\x00\x00\x03\x42\x83\x02" * 400])
def test_a_flood_ends(wire: tuple[Callable[[], None], HostileServer, list[bytes]], flood: bytes) -> None:
    ask, server, _ = wire
    server.talk, server.endless = flood, True
    with pytest.raises((ConnectionLost, DeviceFault)):
        ask()


def test_a_dashboard_that_talks_without_end_after_its_greeting_is_left() -> None:
    with HostileServer(HOST, dashboard.PORT, b"Connected: Universal Robots Dashboard Server\n", endless=True):
        ask_dashboard(0)
