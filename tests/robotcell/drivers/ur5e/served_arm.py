"""A served arm and what its tests do with it. The bounds on times are those that a cell relies on."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.config import load_config
from robotcell.drivers.clock import WallClock
from robotcell.drivers.ur5e.arm import UR5e, UR5eOptions
from robotcell.errors import CellError, ConnectionLost
from robotcell.interfaces import ArmMode
from sim_twin.wire.faults import Fault, Kind
from tests.robotcell.drivers.served_cell import HOST

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.geometry.transforms import Array
    from sim_twin.wire.cell import ServedCell

PERIOD_S = 0.008
LIMIT_S = 20.0
# A controller that is lost, silent or garbling is an error within a second; a busy machine gets as much again.
LOST_S = 2.0
# From the moment that something dies until the arm stands.
STANDS_S = 0.3
_STANDS_RAD_S = 0.02
# The fastest joint of a descent turns at 0.2 rad/s.
_AT_SPEED_RAD_S = 0.1


def make_arm(host: str = HOST) -> UR5e:
    """A driver, not yet connected."""
    return UR5e(UR5eOptions(host=host), WallClock())


def fault(channel: str, kind: Kind, what: str = "", value: float | None = None) -> Fault:
    """A fault of the arm."""
    return Fault("arm", channel, kind, what, value)


def start_descent(arm: UR5e) -> None:
    """Start a slow straight motion of 0.15 m from above home, and supervise it until it is at speed."""
    T = arm.state().T_base_tcp.copy()
    T[2, 3] -= 0.15
    arm.start_linear(T, 0.1, 1.2)
    end = time.monotonic() + LIMIT_S
    while np.abs(arm.state().qd).max() < _AT_SPEED_RAD_S:
        assert arm.moving
        assert time.monotonic() < end
        arm.kick()
        time.sleep(PERIOD_S)


def keep_moving(arm: UR5e, seconds: float) -> None:
    """Supervise a motion for some time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and arm.moving:
        arm.kick()
        time.sleep(PERIOD_S)


def finish(arm: UR5e) -> None:
    """Supervise a motion to its end."""
    keep_moving(arm, 20.0)
    assert not arm.moving


def go_home(arm: UR5e) -> None:
    """Take the arm home."""
    home = np.array(load_config().motion.home_q)
    if np.abs(arm.state().q - home).max() > 1e-3:
        arm.start_joints(home, 2.0, 4.0)
        finish(arm)


def works(arm: UR5e) -> None:
    """Connect as after a fault, leave whatever stop there is, and move."""
    # What was lifted may need a moment: a program to be stopped, brakes to be opened.
    deadline = time.monotonic() + 10.0
    while True:
        try:
            arm.connect()
            arm.recover()
            break
        except CellError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)
    assert arm.state().mode is ArmMode.READY
    go_home(arm)


def wait_until(condition: Callable[[], bool], seconds: float = LIMIT_S) -> float:
    """Wait for something; how long that took [s]. The limit is to end the test, unless another is given."""
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < seconds, f"not within {seconds} s"
        time.sleep(0.002)
    return time.monotonic() - begin


def is_lost(arm: UR5e) -> float:
    """Supervise the arm until its connection is lost; how long that took [s]."""
    begin = time.monotonic()
    while time.monotonic() - begin < LOST_S:
        try:
            arm.kick()
        except ConnectionLost:
            break
        time.sleep(PERIOD_S)
    else:
        pytest.fail(f"still connected after {LOST_S} s")
    return time.monotonic() - begin


def joints(served: ServedCell) -> Array:
    """Joint angles of the world's arm."""
    return np.array(served.state()["q"])


def stands_after(served: ServedCell, event: Callable[[], None]) -> float:
    """From an event until the world's arm stands still for good [s]."""
    samples: list[tuple[float, float]] = []
    event()
    begin = time.monotonic()
    while time.monotonic() - begin < 2 * STANDS_S:
        state = served.state()
        samples.append((float(state["wall"]) - begin, float(np.abs(state["qd"]).max())))
        time.sleep(0.002)
    assert samples[0][1] > _STANDS_RAD_S, "the arm has to move when it happens"
    assert samples[-1][1] < _STANDS_RAD_S, "the arm still moves"
    return max(t for t, speed in samples if speed > _STANDS_RAD_S)
