"""Every fault of controller and link that the served cell knows: an error in time, and a cell that works again."""

from __future__ import annotations

import enum
import time
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest

from robotcell.errors import CellError, ConnectionLost, DeviceFault
from robotcell.interfaces import ArmMode
from sim_twin.wire.faults import Kind
from tests.robotcell.drivers.ur5e.served_arm import (
    LOST_S,
    STANDS_S,
    fault,
    finish,
    go_home,
    is_lost,
    joints,
    keep_moving,
    make_arm,
    stands_after,
    start_descent,
    wait_until,
    works,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.drivers.ur5e.arm import UR5e
    from sim_twin.wire.cell import ServedCell

WRONG = Kind.WRONG
# A connection that these hit in the middle of a motion is lost within a second, and the arm stands.
LOST = [
    ("rtde", Kind.OFF, "", None),
    ("rtde", Kind.STUCK, "", None),
    ("rtde", Kind.GARBAGE, "", None),
    ("rtde", Kind.GARBAGE, "zero_length", None),
    ("rtde", Kind.DELAYED, "", 1.0),
    ("rtde", Kind.INTERMITTENT, "", 0.3),
]
# What `connect` says, by fault.
REFUSED: list[tuple[str, Kind, str, float | None, type[CellError], str]] = [
    ("rtde", Kind.OFF, "", None, ConnectionLost, r"30004.*check that the controller has booted"),
    ("rtde", Kind.STUCK, "", None, ConnectionLost, "30004.*sent nothing for 1 s"),
    ("rtde", Kind.GARBAGE, "", None, ConnectionLost, "30004.*not RTDE"),
    ("rtde", Kind.GARBAGE, "zero_length", None, ConnectionLost, "30004"),
    ("rtde", Kind.DELAYED, "", 2.0, ConnectionLost, "30004.*sent nothing for 1 s"),
    ("rtde", WRONG, "version", None, ConnectionLost, "version 2 of the protocol"),
    ("rtde", WRONG, "not_found", None, ConnectionLost, "does not know"),
    ("rtde", WRONG, "in_use", None, DeviceFault, "EtherNet/IP, PROFINET"),
    ("dashboard", Kind.OFF, "", None, ConnectionLost, "29999"),
    ("dashboard", Kind.STUCK, "", None, ConnectionLost, "29999.*did not answer within 1 s"),
    ("dashboard", Kind.GARBAGE, "", None, ConnectionLost, "29999 greets with"),
    ("script", Kind.OFF, "", None, ConnectionLost, "30003"),
    ("script", Kind.STUCK, "", None, DeviceFault, "does not start the program"),
    ("state", WRONG, "power_off", None, DeviceFault, "powered off: power it on"),
    ("state", WRONG, "brakes_locked", None, DeviceFault, "release the brakes"),
    ("state", WRONG, "booting", None, DeviceFault, "booting"),
    ("state", WRONG, "safeguard_stop", None, DeviceFault, "safeguard stop: close the guard"),
    ("state", WRONG, "emergency_stop", None, DeviceFault, "emergency stop: release the button"),
    ("state", WRONG, "violation", None, DeviceFault, "safety violation"),
    ("state", WRONG, "local_control", None, DeviceFault, "Settings > System > Remote Control"),
    ("state", WRONG, "speed_slider", 0.0, DeviceFault, "slider is at 0 %"),
    ("state", WRONG, "speed_slider", 0.02, DeviceFault, "slider is at 2 %"),
    ("state", WRONG, "tcp", None, DeviceFault, "tool's centre point"),
    ("state", WRONG, "payload", None, DeviceFault, "tool's mass"),
]
# A motion that these cut short: the mode afterwards.
STOPPED = [
    ("program_stopped", ArmMode.NOT_READY),
    ("program_paused", ArmMode.NOT_READY),
    ("protective_stop", ArmMode.PROTECTIVE_STOP),
    ("safeguard_stop", ArmMode.NOT_READY),
    ("emergency_stop", ArmMode.EMERGENCY_STOP),
    ("power_off", ArmMode.NOT_READY),
    ("violation", ArmMode.NOT_READY),
]


@pytest.fixture
def closed_arm(served: ServedCell) -> Iterator[UR5e]:
    """An arm that is not connected; afterwards the cell is whole again."""
    arm = make_arm()
    try:
        yield arm
    finally:
        served.clear()
        arm.close()


@pytest.fixture
def arm(closed_arm: UR5e) -> UR5e:
    """A connected arm at home."""
    works(closed_arm)
    return closed_arm


def name(value: object) -> str | None:
    if isinstance(value, type):
        return value.__name__
    return str(value.value) if isinstance(value, enum.Enum) else None


def test_a_link_that_fails_in_a_motion_is_lost_and_the_arm_stands(served: ServedCell, arm: UR5e) -> None:
    # One fault after another: each ends the connection that was made again after the one before.
    for channel, kind, what, value in LOST:
        failing = f"{channel} {kind.value} {what}"
        start_descent(arm)
        child = arm.pid
        assert child is not None
        served.inject(fault(channel, kind, what, value))
        assert is_lost(arm) < LOST_S, failing
        at_loss = joints(served)
        assert not psutil.pid_exists(child), failing
        time.sleep(STANDS_S)
        now = joints(served)
        assert np.abs(now - at_loss).max() < 0.1, failing
        time.sleep(0.2)
        np.testing.assert_allclose(joints(served), now, atol=2e-3, err_msg=failing)
        with pytest.raises(ConnectionLost, match="connect it again"):
            arm.state()
        served.clear()
        works(arm)


@pytest.mark.wire
@pytest.mark.parametrize(("channel", "kind", "what", "value", "error", "words"), REFUSED, ids=name)
def test_connecting_says_what_is_wrong(
    served: ServedCell,
    closed_arm: UR5e,
    channel: str,
    kind: Kind,
    what: str,
    value: float | None,
    error: type[CellError],
    words: str,
) -> None:
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    served.inject(fault(channel, kind, what, value))
    begin = time.monotonic()
    with pytest.raises(error, match=words):
        closed_arm.connect()
    # The controller is given 4 s to start a program; everything else is known within one or two time-outs of a second.
    assert time.monotonic() - begin < (9.0 if channel == "script" else 4.0)
    assert {child.pid for child in psutil.Process().children(recursive=True)} == before
    with pytest.raises(ConnectionLost):
        closed_arm.state()
    served.clear()
    works(closed_arm)


@pytest.mark.wire
@pytest.mark.parametrize(("what", "mode"), STOPPED, ids=name)
def test_a_stop_in_a_motion_is_seen_at_once_and_nothing_moves_until_recovered(
    served: ServedCell, arm: UR5e, what: str, mode: ArmMode
) -> None:
    start_descent(arm)
    served.inject(fault("state", WRONG, what))
    wait_until(lambda: arm.state().mode is mode, 1.0)
    wait_until(lambda: not arm.moving, 1.0)
    with pytest.raises(DeviceFault, match="recover"):
        arm.start_joints(arm.state().q + 0.01, 0.5, 1.0)
    arm.stop()
    arm.kick()
    at_stop = joints(served)
    served.clear()
    time.sleep(0.3)
    np.testing.assert_allclose(joints(served), at_stop, atol=2e-3)
    if mode is not ArmMode.PROTECTIVE_STOP:
        assert arm.state().mode is not ArmMode.READY, "nothing but recover makes it ready"
    works(arm)


def test_recover_says_what_to_do_while_the_button_is_pressed(served: ServedCell, arm: UR5e) -> None:
    served.inject(fault("state", WRONG, "emergency_stop"))
    wait_until(lambda: arm.state().mode is ArmMode.EMERGENCY_STOP)
    with pytest.raises(DeviceFault, match="release the button"):
        arm.recover()
    assert arm.state().mode is ArmMode.EMERGENCY_STOP


def test_a_controller_without_a_solution_is_a_fault_with_words(served: ServedCell, arm: UR5e) -> None:
    served.inject(fault("ik", WRONG, "none"))
    T = arm.state().T_base_tcp.copy()
    T[2, 3] -= 0.05
    try:
        arm.start_linear(T, 0.1, 1.0)
    except DeviceFault as error:
        assert "recover" in str(error)
    wait_until(lambda: arm.state().mode is ArmMode.NOT_READY and not arm.moving)
    served.clear()
    works(arm)


# What leaves the connection as it is shares one. It comes last, as the controller has one program at a time.


def test_a_slider_that_goes_to_nothing_refuses_the_next_motion(served: ServedCell, shared_arm: UR5e) -> None:
    served.inject(fault("state", WRONG, "speed_slider", 0.01))
    time.sleep(0.1)
    with pytest.raises(DeviceFault, match="slider is at 1 %"):
        shared_arm.start_joints(shared_arm.state().q + 0.01, 0.5, 1.0)
    served.clear()
    time.sleep(0.1)
    go_home(shared_arm)


def test_a_motion_that_never_arrives_goes_on_until_it_is_stopped(served: ServedCell, shared_arm: UR5e) -> None:
    served.inject(fault("state", WRONG, "never_arrives"))
    q = shared_arm.state().q
    q[5] += 0.05
    shared_arm.start_joints(q, 0.5, 2.0)
    keep_moving(shared_arm, 1.0)
    assert shared_arm.moving
    shared_arm.stop()
    finish(shared_arm)
    assert shared_arm.state().mode is ArmMode.READY


def test_a_slow_stream_is_worked_with(served: ServedCell, shared_arm: UR5e) -> None:
    served.inject(fault("rtde", Kind.SLOW, "", 0.2))
    start_descent(shared_arm)
    assert stands_after(served, shared_arm.stop) < STANDS_S + 0.1
    finish(shared_arm)


def test_stop_works_without_a_dashboard(served: ServedCell, shared_arm: UR5e) -> None:
    start_descent(shared_arm)
    served.inject(fault("dashboard", Kind.OFF))
    assert stands_after(served, shared_arm.stop) < STANDS_S
    finish(shared_arm)
    assert shared_arm.state().mode is ArmMode.READY
