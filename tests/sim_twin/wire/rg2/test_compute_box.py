"""The register map, with a world that a test writes."""

import multiprocessing

import pytest

from robotcell.geometry import rg2
from sim_twin.wire.faults import Fault, FaultInbox, Kind
from sim_twin.wire.rg2.compute_box import Rg2
from sim_twin.wire.rg2.modbus import RefusedError
from sim_twin.wire.shared_state import CELL_STATE, GRIPPER_COMMAND, Record

ADDRESS, VALUE = 2, 3


class Bench:
    """The units of a box, and the two records between them and a world."""

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
def bench():
    bench = Bench()
    yield bench
    for thing in bench.closing:
        thing.close()


def test_says_what_it_is(bench):
    assert bench.read(1536) == 0x20
    assert bench.read(1540, 2) == [0x0100, 1]
    serial = b"".join(value.to_bytes(2, "big") for value in bench.read(1545, 16))
    assert serial.rstrip(b"\0").decode("ascii").isprintable()


@pytest.mark.parametrize("offset", [0, 49, -30])
def test_widths_depth_and_signed_offset(bench, offset):
    bench.units.write(65, 1031, [offset & 0xFFFF])
    assert bench.read(258) == offset & 0xFFFF
    assert bench.read(267) == 800
    assert bench.read(275) == (800 - 2 * offset) & 0xFFFF
    assert bench.read(263) == round(10_000 * rg2.tip_retraction(0.08))
    assert bench.read(264) == 0
    bench.units.write(65, 0, [200, 300, 1])
    bench.take_up(width_m=0.03)
    moved = rg2.tip_retraction(0.03) - rg2.tip_retraction(0.08)
    assert bench.read(264) == round(10_000 * moved) & 0xFFFF


def test_public_drivers_read_the_state_in_one_piece(bench):
    values = bench.read(258, 18)
    assert values[267 - 258] == values[275 - 258] == 800


@pytest.mark.parametrize(
    ("address", "count"), [(0, 1), (257, 1), (258, 19), (276, 1), (1031, 1), (1537, 1), (65535, 2)]
)
def test_what_cannot_be_read(bench, address, count):
    with pytest.raises(RefusedError) as refusal:
        bench.read(address, count)
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
def test_a_refused_write_changes_nothing(bench, address, values, code):
    assert bench.refused(65, address, values) == code
    assert bench.command.read()["count"] == 0
    assert bench.read(268) == 0


@pytest.mark.parametrize(
    ("control", "offset", "width"), [(1, 50, 0.03), (16, 50, 0.04), (16, -50, 0.02), (16, 500, 0.11)]
)
def test_a_grip_with_or_without_the_offset(bench, control, offset, width):
    bench.units.write(65, 1031, [offset & 0xFFFF])
    bench.units.write(65, 0, [250, 300, control])
    command = bench.command.read()
    assert (command["count"], command["stop"]) == (1, 0)
    assert (command["width_m"], command["force_n"]) == pytest.approx((width, 25.0))


def test_targets_stay_until_they_are_changed(bench):
    bench.units.write(65, 0, [250])
    bench.units.write(65, 1, [300])
    assert bench.command.read()["count"] == 0
    bench.units.write(65, 2, [1])
    assert (bench.command.read()["width_m"], bench.command.read()["force_n"]) == pytest.approx((0.03, 25.0))


def test_busy_from_the_command_on_and_deaf_meanwhile(bench):
    bench.units.write(65, 0, [250, 300, 16])
    assert bench.read(268) == 1
    bench.units.write(65, 0, [250, 500, 16])
    assert bench.command.read()["count"] == 1
    bench.take_up(busy=True)
    assert bench.read(268) == 1
    bench.units.write(65, 0, [250, 500, 16])
    assert bench.command.read()["width_m"] == pytest.approx(0.03)
    bench.units.write(65, 2, [8])
    assert (bench.command.read()["count"], bench.command.read()["stop"]) == (2, 1)
    bench.take_up(busy=False)
    bench.units.write(65, 2, [16])
    assert bench.command.read()["width_m"] == pytest.approx(0.05)


def test_a_grip_counts_right_after_a_stop(bench):
    bench.units.write(65, 0, [250, 300, 16])
    bench.take_up(busy=True)
    # Nothing of this has reached the world yet, which still says that the fingers move.
    bench.units.write(65, 2, [8])
    bench.units.write(65, 1, [500])
    bench.units.write(65, 2, [16])
    assert bench.command.read()["width_m"] == pytest.approx(0.05)
    assert not bench.command.read()["stop"]
    bench.units.write(65, 1, [600])
    bench.units.write(65, 2, [16])
    assert bench.command.read()["width_m"] == pytest.approx(0.05), "the second grip came while busy"


def test_a_stop_does_not_end_a_fault_that_is_busy_for_ever(bench):
    bench.set_faults(("state", Kind.WRONG, "busy"))
    bench.units.write(65, 2, [8])
    bench.units.write(65, 0, [250, 300, 16])
    assert bench.command.read()["stop"]


def test_a_grip_is_reported(bench):
    bench.state.write(grip_detected=True)
    assert bench.read(268) == 2


@pytest.mark.parametrize(("switch", "pushed", "tripped"), [("s1", 4, 8), ("s2", 16, 32)])
def test_a_tripped_switch_needs_a_power_cycle(bench, switch, pushed, tripped):
    bench.set_faults(("state", Kind.WRONG, switch))
    assert bench.command.read()["stop"]
    assert bench.read(268) & ~1 == pushed | tripped
    bench.set_faults()
    bench.take_up()
    assert bench.read(268) == tripped
    bench.units.write(65, 0, [250, 300, 16])
    assert bench.command.read()["count"] == 1
    bench.units.write(63, 0, [2])
    assert bench.units.answers(63)
    assert not bench.units.answers(65)
    bench.now += 2.0
    assert bench.units.answers(65)
    bench.take_up()
    assert bench.read(268) == 0
    bench.units.write(65, 0, [250, 300, 16])
    assert bench.command.read()["width_m"] == pytest.approx(0.03)


def test_a_switch_that_is_pushed_at_power_on_is_a_safety_error(bench):
    bench.set_faults(("state", Kind.WRONG, "s1"))
    bench.units.write(63, 0, [2])
    bench.take_up()
    assert bench.read(268) == 4 | 8 | 64
    bench.set_faults()
    bench.units.write(63, 0, [2])
    bench.take_up()
    assert bench.read(268) == 0


def test_the_box_takes_nothing_but_a_power_cycle(bench):
    assert bench.refused(63, 0, [1]) == VALUE
    assert bench.refused(63, 1, [2]) == ADDRESS
    assert bench.units.read(63, 0, 1) == [0]


@pytest.mark.parametrize(
    ("what", "state", "status"),
    [
        ("busy", {}, 1),
        ("grip", {}, 2),
        ("no_grip", {"grip_detected": True}, 0),
        ("safety_error", {}, 64),
    ],
)
def test_wrong_status_bits(bench, what, state, status):
    bench.state.write(**state)
    bench.set_faults(("state", Kind.WRONG, what))
    assert bench.read(268) == status


def test_a_wrong_offset_and_a_frozen_width(bench):
    bench.set_faults(("state", Kind.WRONG, "offset", 0.002), ("state", Kind.STUCK))
    assert bench.read(258) == 20
    bench.state.write(width_m=0.03)
    assert (bench.read(267), bench.read(275)) == (800, 760)
    bench.set_faults()
    assert (bench.read(258), bench.read(267), bench.read(275)) == (0, 300, 300)


def test_a_wrong_unit_answers_elsewhere(bench):
    bench.set_faults(("modbus", Kind.WRONG, "unit"))
    assert [unit for unit in range(256) if bench.units.answers(unit)] == [63, 66]
