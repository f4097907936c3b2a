"""The RTDE protocol of the served controller: bytes in, bytes out, without sockets."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_twin.wire.ur.controller import VERSION, Controller
from sim_twin.wire.ur.rtde import ProtocolError, RtdeSession
from sim_twin.wire.ur.snapshot import Snapshot
from sim_twin.wire.ur.variables import INPUTS, OUTPUTS, Recipe
from tests.sim_twin.wire.ur.stepped_controller import answers
from tests.sim_twin.wire.ur.stub_world import START_Q

# Universal Robots, RTDE guide: bytes of each type.
SIZES = {
    "BOOL": 1,
    "UINT8": 1,
    "UINT32": 4,
    "UINT64": 8,
    "INT32": 4,
    "DOUBLE": 8,
    "VECTOR3D": 24,
    "VECTOR6D": 48,
    "VECTOR6INT32": 24,
}
# What ur_rtde 1.6.5 asks of a PolyScope 5.12, and the bytes of its packages.
RECEIVE = (
    "timestamp,target_q,target_qd,target_qdd,target_current,target_moment,actual_q,actual_qd,actual_current,"
    "joint_control_output,actual_TCP_pose,actual_TCP_speed,actual_TCP_force,target_TCP_pose,target_TCP_speed,"
    "actual_digital_input_bits,joint_temperatures,actual_execution_time,robot_mode,joint_mode,safety_mode,"
    "actual_tool_accelerometer,speed_scaling,target_speed_fraction,actual_momentum,actual_main_voltage,"
    "actual_robot_voltage,actual_robot_current,actual_joint_voltage,actual_digital_output_bits,runtime_state,"
    "standard_analog_input0,standard_analog_input1,standard_analog_output0,standard_analog_output1,robot_status_bits,"
    "safety_status_bits,ft_raw_wrench,payload,payload_cog,payload_inertia,"
    + ",".join(f"output_int_register_{i}" for i in (2, *range(12, 20)))
    + ","
    + ",".join(f"output_double_register_{i}" for i in range(12, 20))
)


def message(kind: str, payload: bytes = b"") -> bytes:
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


def split(data: bytes) -> list[tuple[str, bytes]]:
    messages = []
    while data:
        size, kind = struct.unpack_from(">HB", data)
        assert 3 <= size <= len(data)
        messages.append((chr(kind), data[3:size]))
        data = data[size:]
    return messages


class RtdeServer:
    """A controller and its sessions."""

    def __init__(self) -> None:
        self.controller = Controller(np.array(START_Q))
        self.claims: dict[str, RtdeSession] = {}

    def session(self, version: int = 2) -> RtdeSession:
        session = RtdeSession(self.controller, self.claims)
        assert split(answers(session, message("V", struct.pack(">H", version)))) == [("V", b"\x01")]
        return session


@pytest.fixture
def server() -> RtdeServer:
    return RtdeServer()


def set_up(session: RtdeSession, names: str, frequency: float = 500.0) -> tuple[int, list[str]]:
    [(kind, payload)] = split(answers(session, message("O", struct.pack(">d", frequency) + names.encode())))
    assert kind == "O"
    return payload[0], payload[1:].decode().split(",")


def test_the_versions_are_negotiated(server: RtdeServer) -> None:
    session = RtdeSession(server.controller, server.claims)
    for version, accepted in ((1, 1), (2, 1), (0, 0), (3, 0)):
        assert split(answers(session, message("V", struct.pack(">H", version)))) == [("V", bytes([accepted]))]
    assert split(answers(session, message("v"))) == [("v", struct.pack(">4I", *VERSION))]


def test_every_variable_travels_as_its_type_says(server: RtdeServer) -> None:
    snapshot = Snapshot(server.controller)
    wrong = {}
    for name, kind in OUTPUTS.items():
        session = server.session()
        answer = set_up(session, name)
        answers(session, message("S"))
        package = session.package(snapshot, 0) or b""
        if answer != (1, [kind]) or len(package) != 3 + 1 + SIZES[kind]:
            wrong[name] = (answer, package)
    assert not wrong
    assert len(OUTPUTS) > 400


def test_the_recipe_of_ur_rtde_has_its_size(server: RtdeServer) -> None:
    session = server.session()
    assert RECEIVE.count(",") + 1 == 58
    number, types = set_up(session, RECEIVE + ",")
    assert (number, len(types)) == (1, 58)
    answers(session, message("S"))
    package = session.package(Snapshot(server.controller), 0)
    assert package is not None
    assert len(package) == 1180


def test_values_come_in_the_order_of_the_names(server: RtdeServer) -> None:
    server.controller.registers.output_double[5] = 2.5
    server.controller.registers.output_int[7] = -3
    session = server.session()
    set_up(session, "output_int_register_7,actual_q,output_double_register_5")
    answers(session, message("S"))
    package = session.package(Snapshot(server.controller), 0)
    assert package is not None
    assert struct.unpack(">B i 6d d", split(package)[0][1]) == (1, -3, *START_Q, 2.5)


def test_an_unknown_variable_is_not_found_and_starts_nothing(server: RtdeServer) -> None:
    session = server.session()
    assert set_up(session, "timestamp,nonsense,actual_q") == (0, ["DOUBLE", "NOT_FOUND", "VECTOR6D"])
    assert split(answers(session, message("S"))) == [("S", b"\x00")]
    assert session.package(Snapshot(server.controller), 0) is None
    assert set_up(session, "timestamp") == (1, ["DOUBLE"])
    assert split(answers(session, message("S"))) == [("S", b"\x01")]


def test_pause_stops_the_packages_and_start_resumes_them(server: RtdeServer) -> None:
    session = server.session()
    set_up(session, "timestamp")
    snapshot = Snapshot(server.controller)
    assert session.package(snapshot, 0) is None
    answers(session, message("S"))
    assert session.package(snapshot, 0) is not None
    assert split(answers(session, message("P"))) == [("P", b"\x01")]
    assert session.package(snapshot, 0) is None
    answers(session, message("S"))
    assert session.package(snapshot, 0) is not None


@pytest.mark.parametrize(("frequency", "every"), [(500, 1), (125, 4), (10, 50), (1000, 1), (0.5, 1000)])
def test_the_frequency_is_a_share_of_the_periods(server: RtdeServer, frequency: float, every: int) -> None:
    session = server.session()
    set_up(session, "timestamp", frequency)
    answers(session, message("S"))
    snapshot = Snapshot(server.controller)
    sent = [tick for tick in range(2 * every + 1) if session.package(snapshot, tick)]
    assert sent == [0, every, 2 * every]


@pytest.mark.parametrize("frequency", [0.0, -1.0, float("nan"), float("inf")])
def test_a_frequency_that_is_none_is_refused(server: RtdeServer, frequency: float) -> None:
    session = server.session()
    assert set_up(session, "timestamp", frequency)[0] == 0
    assert split(answers(session, message("S"))) == [("S", b"\x00")]


def test_version_1_has_neither_frequency_nor_numbers(server: RtdeServer) -> None:
    session = RtdeSession(server.controller, server.claims)
    assert split(answers(session, message("O", b"timestamp,actual_q"))) == [("O", b"DOUBLE,VECTOR6D")]
    answers(session, message("S"))
    snapshot = Snapshot(server.controller)
    packages = [session.package(snapshot, tick) for tick in range(4)]
    assert [package is not None for package in packages] == [True, False, False, False]
    assert packages[0] is not None
    assert struct.unpack(">7d", split(packages[0])[0][1]) == (0.0, *START_Q)
    [(kind, payload)] = split(answers(session, message("?")))
    assert (kind, payload[0]) == ("M", 2)
    assert b"not understood" in payload


def test_input_recipes_are_numbered_from_one_in_each_connection(server: RtdeServer) -> None:
    first, second = server.session(), server.session()
    for number in (1, 2, 3):
        [(_, payload)] = split(answers(first, message("I", b"input_int_register_0,input_double_register_0,")))
        assert payload == bytes([number]) + b"INT32,DOUBLE"
    [(_, payload)] = split(answers(second, message("I", b"input_int_register_1")))
    assert payload == b"\x01INT32"


def test_inputs_of_another_connection_are_in_use_until_it_ends(server: RtdeServer) -> None:
    first, second = server.session(), server.session()
    answers(first, message("I", b"input_int_register_0,speed_slider_mask"))
    request = message("I", b"input_int_register_0,input_int_register_1,nonsense")
    assert split(answers(second, request)) == [("I", b"\x00IN_USE,INT32,NOT_FOUND")]
    # A refused recipe claims nothing.
    assert split(answers(first, message("I", b"input_int_register_1"))) == [("I", b"\x02INT32")]
    first.close()
    assert split(answers(second, message("I", b"input_int_register_0"))) == [("I", b"\x01INT32")]


def test_what_is_written_can_be_read_back(server: RtdeServer) -> None:
    session = server.session()
    names = [name for name in INPUTS if name.startswith("input_")]
    answers(session, message("I", ",".join(names).encode()))
    recipe = Recipe(names, [INPUTS[name] for name in names])
    values = [i % 2 == 1 if INPUTS[name] == "BOOL" else i for i, name in enumerate(names)]
    assert answers(session, message("U", b"\x01" + recipe.pack(values))) == b""
    snapshot = Snapshot(server.controller)
    assert [snapshot[name] for name in names] == values


def test_outputs_are_switched_under_their_masks(server: RtdeServer) -> None:
    session = server.session()
    names = b"standard_digital_output_mask,standard_digital_output,tool_digital_output_mask,tool_digital_output"
    answers(session, message("I", names + b",speed_slider_mask,speed_slider_fraction"))
    server.controller.outputs.digital = 0b100
    answers(session, message("U", struct.pack(">5BId", 1, 0b11, 0b10, 0b1, 0b1, 1, 0.25)))
    assert server.controller.outputs.digital == 1 << 16 | 0b110
    assert server.controller.slider == 0.25
    answers(session, message("U", struct.pack(">5BId", 1, 0, 0, 0, 0, 0, 1.0)))
    assert server.controller.slider == 0.25
    answers(session, message("U", struct.pack(">5BId", 1, 0, 0, 0, 0, 1, float("nan"))))
    assert server.controller.slider == 0.25


def test_analog_outputs_are_currents_or_voltages(server: RtdeServer) -> None:
    session = server.session()
    answers(
        session,
        message(
            "I",
            b"standard_analog_output_mask,standard_analog_output_type,standard_analog_output_0,standard_analog_output_1",
        ),
    )
    answers(session, message("U", struct.pack(">3Bdd", 1, 0b11, 0b10, 0.5, 0.5)))
    snapshot = Snapshot(server.controller)
    assert snapshot["standard_analog_output0"] == pytest.approx(0.012)
    assert snapshot["standard_analog_output1"] == pytest.approx(5.0)
    assert snapshot["analog_io_types"] == 0b1000


def test_a_package_that_fits_no_recipe_is_answered_by_a_warning(server: RtdeServer) -> None:
    session = server.session()
    answers(session, message("I", b"input_int_register_0"))
    for payload in (b"", b"\x01", b"\x01\x00\x00\x00\x01\x00", b"\x07\x00\x00\x00\x01"):
        [(kind, text)] = split(answers(session, message("U", payload)))
        assert kind == "M"
        assert b"does not fit" in text
    assert server.controller.registers.input_int[0] == 0


def test_a_message_shorter_than_its_header_ends_the_connection(server: RtdeServer) -> None:
    with pytest.raises(ProtocolError):
        answers(server.session(), b"\x00\x02V")


REQUESTS = st.one_of(
    st.tuples(st.sampled_from("VvOISPUM?\x00"), st.binary(max_size=40)),
    st.tuples(st.just("O"), st.sampled_from([*OUTPUTS]).map(lambda name: struct.pack(">d", 500) + name.encode())),
    st.tuples(st.just("I"), st.sampled_from([*INPUTS]).map(str.encode)),
    st.tuples(st.just("S"), st.just(b"")),
)


@given(requests=st.lists(REQUESTS, max_size=8), cuts=st.lists(st.integers(0, 400), max_size=6))
def test_it_does_not_matter_how_the_stream_is_cut(requests: list[tuple[str, bytes]], cuts: list[int]) -> None:
    stream = b"".join(message(kind, payload) for kind, payload in requests)
    whole = answers(RtdeServer().session(), stream)
    session = RtdeServer().session()
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert b"".join(answers(session, stream[a:b]) for a, b in itertools.pairwise(edges)) == whole
    # Whatever came, the answers are whole messages.
    split(whole)


@given(st.binary(max_size=300))
def test_any_bytes_are_answered_by_messages_or_end_the_connection(data: bytes) -> None:
    server = RtdeServer()
    session = server.session()
    try:
        split(answers(session, data))
    except ProtocolError:
        return
    session.package(Snapshot(server.controller), 0)


@given(st.data())
def test_packing_and_unpacking_agree(data: st.DataObject) -> None:
    names = data.draw(st.lists(st.sampled_from([*INPUTS]), unique=True, min_size=1, max_size=10))
    types = [INPUTS[name] for name in names]
    values = [data.draw(_VALUES[kind]) for kind in types]
    recipe = Recipe(names, types)
    packed = recipe.pack(values)
    assert len(packed) == recipe.size == sum(SIZES[kind] for kind in types)
    assert dict(recipe.unpack(packed)) == dict(zip(names, values, strict=True))


_FLOATS = st.floats(allow_nan=False)
_VALUES = {
    "BOOL": st.booleans(),
    "UINT8": st.integers(0, 255),
    "UINT32": st.integers(0, 2**32 - 1),
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "DOUBLE": _FLOATS,
    "VECTOR6D": st.tuples(*[_FLOATS] * 6),
}
