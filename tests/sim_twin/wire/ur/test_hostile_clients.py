"""Whatever a client sends, the controller goes on: without sockets for each protocol, and over them for all ports."""

from __future__ import annotations

import contextlib
import re
import socket
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_twin.wire.ur.launch import launch
from tests.sim_twin.wire.ur.rtde_client import reading
from tests.sim_twin.wire.ur.stepped_controller import SteppedController, SteppedControlLoop, received
from tests.sim_twin.wire.ur.stub_world import ServedController

if TYPE_CHECKING:
    from collections.abc import Iterator

HOST = "127.0.0.39"
PORTS = (29999, 30001, 30002, 30003, 30004, 30011)
# What the wires carry, so that noise gets past the first check.
WORDS = [
    b"\x00\x05V\x00\x02",
    b"\x00\x03S",
    b"\x00\x0bO" + bytes(8),
    b"\x00\x17Iinput_int_register_0",
    b"\x00\x08U\x01" + bytes(4),
    b"stop\n",
    b"robotmode\n",
    b"def p():\n",
    b"end\n",
    b"sync()\n",
    b"halt\n",
]
NOISE = st.lists(st.one_of(st.sampled_from(WORDS), st.binary(max_size=60)), max_size=10).map(b"".join)

NUMBERS = st.one_of(
    st.integers(-3, 100),
    st.floats(-10, 10).map(lambda x: round(x, 3)),
    st.sampled_from(
        ["1e999", "-1e999", "1e999-1e999", "1e308", "1e-308", "True", "2**9", '"text"', "[]", "p[0,0,0,0,0,0]"]
    ),
)
SIX = st.lists(NUMBERS, min_size=5, max_size=7).map(lambda numbers: f"[{','.join(map(str, numbers))}]")
VALUES = st.one_of(NUMBERS, SIX, SIX.map(lambda text: f"p{text}"))
NAMES = st.sampled_from(
    re.findall(
        r"\w+",
        """movej movel movep stopj stopl speedj speedl servoj sleep sync set_tcp set_payload set_target_payload textmsg
        popup set_digital_out set_tool_digital_out set_analog_out write_output_integer_register halt fly zero_ftsensor
        write_output_float_register write_output_boolean_register protective_stop freedrive_mode end_freedrive_mode""",
    )
)
CALLS = st.builds(lambda name, values: f"{name}({','.join(map(str, values))})", NAMES, st.lists(VALUES, max_size=5))


@settings(max_examples=25)
@given(st.lists(CALLS, min_size=1, max_size=4))
def test_statements_with_any_arguments_run_or_are_refused(calls: list[str]) -> None:
    stepped = SteppedController()
    for text in (
        "def p():\n" + "\n".join(calls) + "\nend\n",
        "sec s():\n" + "\n".join(calls) + "\nend\n",
        calls[0] + "\n",
    ):
        for one in received(text.encode()):
            launch(stepped.controller, one)
        stepped.tick(3)
    assert stepped.controller.ticks == 9


WILD = st.one_of(st.floats(-10, 10), st.sampled_from([0.0, 1e300, -1e300, float("inf"), float("nan")]))


@settings(max_examples=40)
@given(st.integers(0, 300), st.lists(WILD, max_size=18), st.lists(st.integers(-(2**31), 2**31 - 1), max_size=7))
def test_the_control_loop_survives_any_registers(command: int, doubles: list[float], ints: list[int]) -> None:
    stepped = SteppedControlLoop()
    stepped.set(command, doubles, ints)
    stepped.tick(3)
    assert stepped.controller.ticks == 4


@pytest.fixture(scope="module")
def served() -> Iterator[ServedController]:
    with ServedController(HOST) as controller:
        yield controller


@settings(max_examples=25)
@given(st.lists(st.tuples(st.sampled_from(PORTS), NOISE, st.booleans()), max_size=6))
def test_noise_on_any_port_disturbs_nobody_else(served: ServedController, talks: list[tuple[int, bytes, bool]]) -> None:
    with contextlib.ExitStack() as stack:
        for port, noise, stays in talks:
            client = stack.enter_context(socket.create_connection((HOST, port), timeout=5))
            with contextlib.suppress(ConnectionError):
                client.sendall(noise)
            if not stays:
                client.close()
        with reading(HOST, "timestamp") as good:
            first, second = good.package(), good.package()
    assert second != first
    assert served.process.is_alive()
