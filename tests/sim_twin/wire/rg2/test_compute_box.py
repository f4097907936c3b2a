"""The register map, with a world that a test writes."""

import multiprocessing

import pytest

from robotcell.geometry import rg2
from sim_twin.wire.faults import Fault, FaultInbox, Kind
from sim_twin.wire.rg2.compute_box import Rg2
from sim_twin.wire.rg2.modbus import RefusedError
from sim_twin.wire.shared_state import CELL_STATE, GRIPPER_COMMAND, Record

ADDRESS, VALUE = 2, 3


class Device:
    """The units of a Compute Box, and the two records between them and a world."""

    def __init__(self):
        self.command, self.state = Record(GRIPPER_COMMAND), Record(CELL_STATE)
        self.state.write(width_m=0.08)
        self.now = 100.0
        self.units = Rg2(self.command, self.state, lambda: self.now)
        receiver, self.faults = multiprocessing.Pipe(duplex=False)
        self.inbox = FaultInbox(receiver, "gripper")
        self.closing = [receiver, self.faults, self.command, self.state]

    def set_faults(self, *words):
        self.faults.send(tuple(Fault("gripper", *fault) for fault in words))
        self.inbox.poll()
        self.units.take_faults(self.inbox)

    def take_up(self, **state):
        """The world has seen the last command."""
        self.state.write(gripper_count=int(self.command.read()["count"]), **state)

    def read(self, address, count=1):
        values = self.units.read(65, address, count)
        return values[0] if count == 1 else values

    def refused(self, unit, address, values):
        with pytest.raises(RefusedError) as refusal:
            self.units.write(unit, address, values)
        return refusal.value.code


@pytest.fixture
def device():
    device = Device()
    yield device
    for thing in device.closing:
        thing.close()


def test_says_what_it_is(device):
    assert device.read(1536) == 0x20
    assert device.read(1540, 2) == [0x0100, 1]
    serial = b"".join(value.to_bytes(2, "big") for value in device.read(1545, 16))
    assert serial.rstrip(b"\0").decode("ascii").isprintable()


@pytest.mark.parametrize("offset", [0, 49, -30])
def test_widths_depth_and_signed_offset(device, offset):
    device.units.write(65, 1031, [offset & 0xFFFF])
    assert device.read(258) == offset & 0xFFFF
    assert device.read(267) == 800
    assert device.read(275) == (800 - 2 * offset) & 0xFFFF
    assert device.read(263) == round(10_000 * rg2.tip_retraction(0.08))
    assert device.read(264) == 0
    device.units.write(65, 0, [200, 300, 1])
    device.take_up(width_m=0.03)
    moved = rg2.tip_retraction(0.03) - rg2.tip_retraction(0.08)
    assert device.read(264) == round(10_000 * moved) & 0xFFFF


def test_public_drivers_read_the_state_in_one_piece(device):
    values = device.read(258, 18)
    assert values[267 - 258] == values[275 - 258] == 800


@pytest.mark.parametrize(
    ("address", "count"), [(0, 1), (257, 1), (258, 19), (276, 1), (1031, 1), (1537, 1), (65535, 2)]
)
def test_what_cannot_be_read(device, address, count):
    with pytest.raises(RefusedError) as refusal:
        device.read(address, count)
    assert refusal.value.code == ADDRESS


@pytest.mark.parametrize(
    ("address", "values", "code"),
    [
        (0, [401], VALUE),
        (1, [1101], VALUE),
        (2, [4], VALUE),
        (0, [200, 1101, 16], VALUE),
        (258, [1], ADDRESS),
        (268, [0], ADDRESS),
        (2, [1, 1], ADDRESS),
        (1030, [1], ADDRESS),
    ],
)
def test_a_refused_write_changes_nothing(device, address, values, code):
    assert device.refused(65, address, values) == code
    assert device.command.read()["count"] == 0
    assert device.read(268) == 0


@pytest.mark.parametrize(
    ("control", "offset", "width"), [(1, 50, 0.03), (16, 50, 0.04), (16, -50, 0.02), (16, 500, 0.11)]
)
def test_a_grip_with_or_without_the_offset(device, control, offset, width):
    device.units.write(65, 1031, [offset & 0xFFFF])
    device.units.write(65, 0, [250, 300, control])
    command = device.command.read()
    assert (command["count"], command["stop"]) == (1, 0)
    assert (command["width_m"], command["force_n"]) == pytest.approx((width, 25.0))


def test_targets_stay_until_they_are_changed(device):
    device.units.write(65, 0, [250])
    device.units.write(65, 1, [300])
    assert device.command.read()["count"] == 0
    device.units.write(65, 2, [1])
    assert (device.command.read()["width_m"], device.command.read()["force_n"]) == pytest.approx((0.03, 25.0))


def test_busy_from_the_command_on_and_deaf_meanwhile(device):
    device.units.write(65, 0, [250, 300, 16])
    assert device.read(268) == 1
    device.units.write(65, 0, [250, 500, 16])
    assert device.command.read()["count"] == 1
    device.take_up(busy=True)
    assert device.read(268) == 1
    device.units.write(65, 0, [250, 500, 16])
    assert device.command.read()["width_m"] == pytest.approx(0.03)
    device.units.write(65, 2, [8])
    assert (device.command.read()["count"], device.command.read()["stop"]) == (2, 1)
    device.take_up(busy=False)
    device.units.write(65, 2, [16])
    assert device.command.read()["width_m"] == pytest.approx(0.05)


def test_a_grip_is_reported(device):
    device.state.write(grip_detected=True)
    assert device.read(268) == 2


@pytest.mark.parametrize(("switch", "pushed", "tripped"), [("s1", 4, 8), ("s2", 16, 32)])
def test_a_tripped_switch_needs_a_power_cycle(device, switch, pushed, tripped):
    device.set_faults(("state", Kind.WRONG, switch))
    assert device.command.read()["stop"]
    assert device.read(268) & ~1 == pushed | tripped
    device.set_faults()
    device.take_up()
    assert device.read(268) == tripped
    device.units.write(65, 0, [250, 300, 16])
    assert device.command.read()["count"] == 1
    device.units.write(63, 0, [2])
    assert device.units.answers(63)
    assert not device.units.answers(65)
    device.now += 2.0
    assert device.units.answers(65)
    device.take_up()
    assert device.read(268) == 0
    device.units.write(65, 0, [250, 300, 16])
    assert device.command.read()["width_m"] == pytest.approx(0.03)


def test_a_switch_that_is_pushed_at_power_on_is_a_safety_error(device):
    device.set_faults(("state", Kind.WRONG, "s1"))
    device.units.write(63, 0, [2])
    device.take_up()
    assert device.read(268) == 4 | 8 | 64
    device.set_faults()
    device.units.write(63, 0, [2])
    device.take_up()
    assert device.read(268) == 0


def test_the_compute_box_takes_nothing_but_a_power_cycle(device):
    assert device.refused(63, 0, [1]) == VALUE
    assert device.refused(63, 1, [2]) == ADDRESS
    assert device.units.read(63, 0, 1) == [0]


@pytest.mark.parametrize(
    ("what", "state", "status"),
    [
        ("busy", {}, 1),
        ("grip", {}, 2),
        ("no_grip", {"grip_detected": True}, 0),
        ("safety_error", {}, 64),
    ],
)
def test_wrong_status_bits(device, what, state, status):
    device.state.write(**state)
    device.set_faults(("state", Kind.WRONG, what))
    assert device.read(268) == status


def test_a_wrong_offset_and_a_frozen_width(device):
    device.set_faults(("state", Kind.WRONG, "offset", 0.002), ("state", Kind.STUCK))
    assert device.read(258) == 20
    device.state.write(width_m=0.03)
    assert (device.read(267), device.read(275)) == (800, 760)
    device.set_faults()
    assert (device.read(258), device.read(267), device.read(275)) == (0, 300, 300)


def test_a_wrong_unit_answers_elsewhere(device):
    device.set_faults(("modbus", Kind.WRONG, "unit"))
    assert [unit for unit in range(256) if device.units.answers(unit)] == [63, 66]
