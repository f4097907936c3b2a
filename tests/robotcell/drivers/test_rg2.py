"""The driver against a served Compute Box with an RG2; tests/contract holds what every gripper does."""

import re
import socket
import struct
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from pydantic import ValidationError
from pymodbus.client import ModbusTcpClient

from robotcell.drivers.clock import WallClock
from robotcell.drivers.rg2 import RG2, RG2Options
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault, UnsafeMotion
from sim_twin.wire.faults import Fault, Kind
from tests.addresses import loopback
from tests.robotcell.drivers.served_cell import HOST, MODBUS_PORT
from tests.sim_twin.cells import joints_at, tool_down

# Twice what a lost, silent or garbling device may hold the program for: computers that run tests are busy.
BOUND_S = 2.0
LIMIT_S = 20.0


@pytest.fixture
def options(served):
    yield RG2Options(host=HOST, port=MODBUS_PORT, timeout_s=0.3)
    served.clear()


@pytest.fixture
def gripper(options):
    with RG2(options, WallClock()) as gripper:
        yield gripper


def inject(served, channel, kind, what="", value=None):
    served.inject(Fault("gripper", channel, kind, what, value))


def soon(holds):
    """Wait until the box has, or no longer has, a fault."""
    end = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def fails_soon(call, error, words):
    """Call until it fails, and say how it fails and that it takes no longer than it may."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        began = time.monotonic()
        try:
            call()
        except error as failure:
            assert time.monotonic() - began < BOUND_S
            assert re.search(words, str(failure)), failure
            assert failure.device == "gripper"
            return
        time.sleep(0.01)
    pytest.fail("nothing failed")


def try_out(gripper):
    """Connect and close."""
    with gripper:
        assert not gripper.state().busy


def works_soon(call):
    """Call until it works."""

    def works():
        try:
            call()
        except (ConnectionLost, DeviceFault):
            return False
        return True

    soon(works)


def go(gripper, width_m, force_n=20.0):
    gripper.start_width(width_m, force_n)
    finish(gripper)
    return gripper.state()


def finish(gripper):
    while gripper.state().busy:
        time.sleep(0.01)


def raw(options):
    """A client of the test's own."""
    client = ModbusTcpClient(options.host, port=options.port, timeout=1, retries=0)
    assert client.connect()
    return client


def test_the_world_sees_what_the_driver_does(served, gripper):
    state = go(gripper, 0.03)
    assert state.width_m == pytest.approx(0.03, abs=5e-4)
    assert served.state()["width_m"] == pytest.approx(0.03, abs=5e-4)
    go(gripper, 0.08)


def test_an_object_is_felt_and_one_without_the_bit_is_a_fault(served, gripper):
    """The cube stands in the middle of the workspace; the arm gets there by a program of its own."""
    above, around = (joints_at(tool_down(-0.5, 0.0, z)) for z in (0.15, 0.015))
    move_arm(served, above, around)
    state = go(gripper, 0.0)
    assert state.grip_detected
    assert 0.044 < state.width_m < 0.0505
    move_arm(served, above)
    inject(served, "state", Kind.WRONG, "no_grip")
    fails_soon(gripper.state, DeviceFault, r"were sent to 0\.0 mm")
    served.clear()
    works_soon(gripper.state)
    assert gripper.state().grip_detected
    state = go(gripper, 0.08)
    assert not state.grip_detected
    assert state.width_m == pytest.approx(0.08, abs=5e-4)


def move_arm(served, *targets):
    host, _, port = served.endpoints["script"].rpartition(":")
    moves = [f"  movej({target.tolist()}, a=1.4, v=1.0)" for target in targets]
    with socket.create_connection((host, int(port)), timeout=5) as script:
        script.sendall("\n".join(["def go():", *moves, "end", ""]).encode())
        soon(lambda: np.abs(served.state()["q"] - targets[-1]).max() < 0.002)


@pytest.mark.parametrize("offset", [0.005, -0.004])
def test_widths_are_between_the_tips_whatever_is_mounted(served, options, offset):
    with RG2(options.model_copy(update={"fingertip_offset_m": offset}), WallClock()) as gripper:
        assert go(gripper, 0.05).width_m == pytest.approx(0.05, abs=5e-4)
        assert served.state()["width_m"] == pytest.approx(0.05 + 2 * offset, abs=5e-4)
        widest = min(0.11, 0.11 - 2 * offset)
        assert go(gripper, widest).width_m == pytest.approx(widest, abs=5e-4)
        for width in (widest + 0.001, max(0.0, -2 * offset) - 0.001):
            with pytest.raises(UnsafeMotion, match="outside") as refusal:
                gripper.start_width(width, 20.0)
            assert refusal.value.device == "gripper"
    with RG2(options, WallClock()) as gripper:
        assert go(gripper, 0.08).width_m == pytest.approx(0.08, abs=5e-4)


def test_the_same_command_under_way_is_not_sent_again(served, gripper):
    gripper.start_width(0.02, 20.0)
    soon(lambda: served.state()["busy"])
    count = served.state()["gripper_count"]
    gripper.start_width(0.02, 20.0)
    time.sleep(0.05)
    assert served.state()["gripper_count"] == count
    go(gripper, 0.08)


def test_a_second_client_is_told_why_it_is_not_served(options, gripper):
    with pytest.raises(ConnectionLost, match="one client at a time"):
        RG2(options, WallClock()).connect()
    assert not gripper.state().busy


def test_nobody_there(options):
    began = time.monotonic()
    with pytest.raises(ConnectionLost, match="nothing answers"):
        RG2(options.model_copy(update={"host": loopback(27)}), WallClock()).connect()
    assert time.monotonic() - began < BOUND_S


LOST = [
    ("off", Kind.OFF, "", None, "hung up"),
    ("silent", Kind.STUCK, "", None, "gave no answer"),
    ("garbled", Kind.GARBAGE, "", None, "no Modbus"),
    ("other unit", Kind.WRONG, "unit", None, "unit 65"),
    ("too late", Kind.DELAYED, "", 0.5, "gave no answer"),
    ("blinking", Kind.INTERMITTENT, "", 0.5, "hung up"),
]


@pytest.mark.parametrize(("kind", "what", "value", "words"), [row[1:] for row in LOST], ids=[row[0] for row in LOST])
def test_a_lost_link_is_said_in_time_and_comes_back_by_connect(served, gripper, kind, what, value, words):
    inject(served, "modbus", kind, what, value)
    fails_soon(gripper.state, ConnectionLost, words)
    for call in (gripper.state, gripper.stop, lambda: gripper.start_width(0.08, 20.0)):
        with pytest.raises(ConnectionLost, match="connect again"):
            call()
    served.clear()
    works_soon(gripper.connect)
    assert go(gripper, 0.08).width_m == pytest.approx(0.08, abs=5e-4)


@pytest.mark.parametrize("call", ["start", "stop"])
def test_a_command_fails_in_the_same_words(served, gripper, call):
    inject(served, "modbus", Kind.STUCK)
    calls = {"stop": gripper.stop, "start": lambda: gripper.start_width(0.08, 20.0)}
    fails_soon(calls[call], ConnectionLost, "gave no answer in 0.3 s")


@pytest.mark.parametrize(("kind", "what"), [(Kind.OFF, ""), (Kind.STUCK, ""), (Kind.GARBAGE, ""), (Kind.WRONG, "unit")])
def test_connect_fails_in_time_and_leaves_nothing(served, options, kind, what):
    gripper = RG2(options, WallClock())
    inject(served, "modbus", kind, what)
    fails_soon(lambda: try_out(gripper), ConnectionLost, "answer|hung up|no Modbus")
    served.clear()
    works_soon(lambda: try_out(gripper))


def test_an_exception_response_is_not_a_lost_link(served, gripper):
    inject(served, "modbus", Kind.WRONG, "exception", 4)
    fails_soon(gripper.state, DeviceFault, r"exception 4 \(device failure\)")
    served.clear()
    works_soon(gripper.state)


def test_a_command_that_got_no_answer_is_not_repeated(served, gripper):
    counts = []

    def stop():
        counts.append(int(served.state()["gripper_count"]))
        gripper.stop()
        soon(lambda: served.state()["gripper_count"] > counts[-1])

    inject(served, "modbus", Kind.DELAYED, "", 0.5)
    fails_soon(stop, ConnectionLost, "gave no answer")
    time.sleep(1.0)
    assert served.state()["gripper_count"] == counts[-1] + 1


def _pushed(gripper):
    """Whether connecting is refused because of a switch that is still pushed."""
    with pytest.raises(DeviceFault) as refusal:
        gripper.connect()
    return "still pushed" in str(refusal.value)


@pytest.mark.parametrize("switch", ["s1", "s2"])
def test_a_tripped_switch_stops_everything_until_an_operator_recovers(served, options, gripper, switch):
    gripper.start_width(0.02, 20.0)
    inject(served, "state", Kind.WRONG, switch)
    words = f"{switch.upper()} has tripped.*still pushed.*robotcell recover"
    fails_soon(gripper.state, DeviceFault, words)
    with pytest.raises(DeviceFault, match=words):
        gripper.start_width(0.05, 20.0)
    soon(lambda: not served.state()["busy"])
    stopped = served.state()["width_m"]
    assert stopped > 0.025
    served.clear()
    gripper.close()
    gripper = RG2(options, WallClock())
    soon(lambda: not _pushed(gripper))
    with pytest.raises(DeviceFault, match="see what pushed"):
        gripper.connect()
    gripper.recover()
    with gripper:
        assert gripper.state().width_m == pytest.approx(stopped, abs=0.002)
        assert go(gripper, 0.08).width_m == pytest.approx(0.08, abs=5e-4)


def test_recover_leaves_a_gripper_that_is_free_as_it_is(served, gripper):
    before = int(served.state()["gripper_count"])
    gripper.recover()
    assert served.state()["gripper_count"] == before
    assert not gripper.state().busy


def test_recover_cannot_cure_a_switch_that_is_still_pushed(served, options):
    gripper = RG2(options.model_copy(update={"power_cycle_timeout_s": 2.0}), WallClock())
    inject(served, "state", Kind.WRONG, "s1")
    fails_soon(lambda: try_out(gripper), DeviceFault, "still pushed")
    with pytest.raises(DeviceFault, match="still pushed"):
        gripper.recover()
    served.clear()
    works_soon(gripper.recover)
    with gripper:
        assert not gripper.state().busy


def test_a_safety_error_is_refused_at_connect(served, options):
    inject(served, "state", Kind.WRONG, "safety_error")
    gripper = RG2(options, WallClock())
    fails_soon(lambda: try_out(gripper), DeviceFault, "safety error at power on")
    served.clear()
    gripper.recover()
    try_out(gripper)


def test_an_offset_that_does_not_stay_is_a_fault(served, options, gripper):
    inject(served, "state", Kind.WRONG, "offset", 0.003)
    fails_soon(gripper.state, DeviceFault, r"offset is 3\.0 mm, the cell's is 0\.0 mm")
    gripper.close()
    with pytest.raises(DeviceFault, match="offset"):
        RG2(options, WallClock()).connect()


def test_busy_for_ever_is_busy_and_takes_no_new_command(served, gripper):
    inject(served, "state", Kind.WRONG, "busy")
    soon(lambda: gripper.state().busy)
    with pytest.raises(DeviceFault, match="still busy"):
        gripper.start_width(0.05, 20.0)


def test_fingers_that_do_not_arrive_and_hold_nothing_are_a_fault(served, gripper):
    inject(served, "state", Kind.STUCK)
    gripper.start_width(0.03, 20.0)
    with pytest.raises(DeviceFault, match=r"rest \d+\.\d mm apart, were sent to 30\.0 mm"):
        finish(gripper)
    served.clear()
    works_soon(gripper.state)
    assert go(gripper, 0.08).width_m == pytest.approx(0.08, abs=5e-4)


def test_a_grip_bit_at_the_commanded_width_is_no_grip(served, options):
    inject(served, "state", Kind.WRONG, "grip")
    client = raw(options)
    soon(lambda: client.read_holding_registers(268, count=1, device_id=65).registers[0] & 2)
    client.close()
    with RG2(options, WallClock()) as gripper:
        assert not go(gripper, 0.05).grip_detected
        served.clear()
        go(gripper, 0.08)


@contextmanager
def box_with(product):
    """A Compute Box that tells the code of the device behind it, and nothing else; where it listens."""
    with socket.create_server((loopback(28), 0)) as server:

        def serve():
            connection, _ = server.accept()
            with connection:
                transaction = connection.recv(64)[:2]
                connection.sendall(transaction + struct.pack(">HHBBBH", 0, 5, 65, 3, 2, product))

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()
        thread.join()


@pytest.mark.parametrize(("product", "words"), [(0x21, "is RG6, not an RG2"), (0x99, r"an unknown device \(0x99\)")])
def test_another_device_is_not_driven(product, words):
    with box_with(product) as (host, port), pytest.raises(DeviceFault, match=words) as refusal:
        RG2(RG2Options(host=host, port=port), WallClock()).connect()
    assert refusal.value.device == "gripper"


def test_close_stops_the_fingers_and_frees_the_box(served, options):
    gripper = RG2(options, WallClock())
    gripper.connect()
    gripper.start_width(0.0, 20.0)
    time.sleep(0.2)
    gripper.close()
    soon(lambda: not served.state()["busy"])
    assert served.state()["width_m"] > 0.02
    client = raw(options)
    assert client.read_holding_registers(268, count=1, device_id=65).registers == [0]
    client.close()
    with gripper:
        go(gripper, 0.08)


def test_close_is_safe_on_a_link_that_died(served, gripper):
    gripper.start_width(0.08, 20.0)
    inject(served, "modbus", Kind.STUCK)
    time.sleep(0.1)
    began = time.monotonic()
    gripper.close()
    gripper.close()
    assert time.monotonic() - began < BOUND_S


def test_no_thread_is_started(options):
    before = threading.active_count()
    with RG2(options, WallClock()):
        assert threading.active_count() == before


@pytest.mark.parametrize(
    "wrong", [{"port": 0}, {"unit": 248}, {"timeout_s": 2.0}, {"fingertip_offset_m": 0.1}, {"adress": "192.168.1.1"}]
)
def test_options_are_checked(wrong):
    with pytest.raises(ValidationError):
        RG2Options(**wrong)


def test_without_the_library_the_cure_is_named(options, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymodbus.client", None)
    with pytest.raises(ConfigError, match=r"robotcell\[hardware\]"):
        RG2(options, WallClock()).connect()
