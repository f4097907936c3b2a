"""The UR5e over the wire: what it refuses, how it stops, and that whatever dies, the served world's arm stands."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest

from robotcell.drivers.ur5e.dashboard import Dashboard
from robotcell.drivers.ur5e.rtde import open_rtde
from robotcell.errors import ConnectionLost, DeviceFault
from robotcell.geometry import rg2
from robotcell.interfaces import ArmMode
from sim_twin.wire.faults import Kind
from tests.addresses import loopback
from tests.robotcell.drivers.served_cell import HOST, serve
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
    from pathlib import Path

    from robotcell.drivers.ur5e.arm import UR5e
    from sim_twin.wire.cell import ServedCell

SECOND_HOST, SECOND_PORTS = loopback(44), (15044, 30444)


@pytest.fixture
def second(tmp_path: Path) -> Iterator[ServedCell]:
    """A cell that is not whole afterwards."""
    with serve(tmp_path, SECOND_HOST, *SECOND_PORTS) as cell:
        yield cell


@pytest.fixture
def arm(served: ServedCell) -> Iterator[UR5e]:
    """A connected arm at home; afterwards the cell is whole again."""
    arm = make_arm()
    try:
        works(arm)
        yield arm
    finally:
        served.clear()
        arm.close()


def test_sets_tool_and_payload_and_leaves_no_program_behind(arm: UR5e) -> None:
    with open_rtde(HOST) as rtde:
        rtde.start(["tcp_offset", "payload", "payload_cog", "runtime_state"], 125)
        values = rtde.read()
    np.testing.assert_allclose(values["tcp_offset"], (0, 0, rg2.CLOSED_LENGTH_M, 0, 0, 0), atol=1e-6)
    assert values["payload"] == pytest.approx(0.78)
    np.testing.assert_allclose(values["payload_cog"], (0, 0, 0.064), atol=1e-6)
    assert values["runtime_state"] == 2
    child = arm.pid
    arm.close()
    assert child is not None
    assert not psutil.pid_exists(child)
    with open_rtde(HOST) as rtde:
        rtde.start(["runtime_state"], 125)
        wait_until(lambda: rtde.read()["runtime_state"] == 1)


def test_stop_reaches_an_arm_whose_child_hangs(served: ServedCell, arm: UR5e) -> None:
    start_descent(arm)
    assert arm.pid is not None
    os.kill(arm.pid, signal.SIGSTOP)
    begin = time.monotonic()
    assert stands_after(served, arm.stop) < STANDS_S
    assert time.monotonic() - begin < 1.0
    is_lost(arm)
    works(arm)


def test_the_arm_stands_when_the_child_dies_however_it_dies(served: ServedCell, arm: UR5e) -> None:
    # One after another: each ends the connection that was made again after the one before.
    for number in (signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT, signal.SIGSTOP):
        start_descent(arm)
        child = arm.pid
        assert child is not None
        assert stands_after(served, partial(os.kill, child, number)) < STANDS_S, number
        assert is_lost(arm) < LOST_S, number
        with pytest.raises(ConnectionLost, match="connect it again") as lost:
            arm.moving  # noqa: B018
        assert lost.value.device == "arm"
        assert not psutil.pid_exists(child)
        works(arm)


OWNER = """
import sys, time
from tests.robotcell.drivers.ur5e.served_arm import make_arm, start_descent, keep_moving
arm = make_arm(sys.argv[1])
arm.connect()
start_descent(arm)
print(arm.pid, flush=True)
keep_moving(arm, 10.0)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_arm_stands_when_our_own_process_dies(served: ServedCell, arm: UR5e, number: signal.Signals) -> None:
    arm.close()
    owner = subprocess.Popen([sys.executable, "-c", OWNER, HOST], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    with owner:
        assert owner.stdout is not None
        try:
            child = int(owner.stdout.readline())
            took = stands_after(served, lambda: os.kill(owner.pid, number))
        finally:
            owner.kill()
    # One that hangs is noticed after 0.2 s without a kick.
    assert took < (STANDS_S if number is signal.SIGKILL else STANDS_S + 0.2)
    wait_until(lambda: not psutil.pid_exists(child))
    works(arm)


def test_the_connection_is_lost_when_the_controller_falls_silent_and_can_be_had_again(
    served: ServedCell, arm: UR5e
) -> None:
    start_descent(arm)
    controller = served.processes["ur"]
    os.kill(controller, signal.SIGSTOP)
    try:
        assert is_lost(arm) < LOST_S
        with pytest.raises(ConnectionLost, match=r"did not|sent nothing|timed out"):
            arm.connect()
    finally:
        os.kill(controller, signal.SIGCONT)
    works(arm)


def test_a_paused_program_that_is_resumed_does_not_move_the_arm(served: ServedCell, arm: UR5e) -> None:
    start_descent(arm)
    served.inject(fault("state", Kind.WRONG, "program_paused"))
    wait_until(lambda: arm.state().mode is ArmMode.NOT_READY and not arm.moving)
    with pytest.raises(DeviceFault, match="recover"):
        start_descent(arm)
    at_pause = joints(served)
    pendant = Dashboard(HOST)
    pendant.connect()
    pendant.ask("play")
    pendant.close()
    time.sleep(0.5)
    assert np.abs(joints(served) - at_pause).max() < 0.02
    assert arm.state().mode is ArmMode.NOT_READY
    works(arm)


def test_a_stop_ends_a_paused_program_for_good(served: ServedCell, arm: UR5e) -> None:
    start_descent(arm)
    served.inject(fault("state", Kind.WRONG, "program_paused"))
    wait_until(lambda: arm.state().mode is ArmMode.NOT_READY)
    arm.stop()
    pendant = Dashboard(HOST)
    pendant.connect()
    wait_until(lambda: pendant.ask("programState").startswith("STOPPED"))
    assert "Failed" in pendant.ask("play")
    pendant.close()
    works(arm)


def test_a_protective_stop_is_left_only_by_recover(served: ServedCell, arm: UR5e) -> None:
    start_descent(arm)
    served.inject(fault("state", Kind.WRONG, "protective_stop"))
    wait_until(lambda: arm.state().mode is ArmMode.PROTECTIVE_STOP and not arm.moving)
    with pytest.raises(DeviceFault, match=r"protective stop.*recover"):
        start_descent(arm)
    # Connecting does not leave it either.
    arm.close()
    arm.connect()
    assert arm.state().mode is ArmMode.PROTECTIVE_STOP
    with pytest.raises(DeviceFault, match="recover"):
        start_descent(arm)
    at_stop = joints(served)
    begin = time.monotonic()
    arm.recover()
    assert time.monotonic() - begin > 2.0
    assert arm.state().mode is ArmMode.READY
    assert not arm.moving
    np.testing.assert_allclose(joints(served), at_stop, atol=1e-3)
    start_descent(arm)
    arm.stop()
    keep_moving(arm, 2.0)
    go_home(arm)


def test_the_arm_stands_when_the_controller_dies(second: ServedCell) -> None:
    with make_arm(SECOND_HOST) as arm:
        start_descent(arm)
        assert stands_after(second, lambda: os.kill(second.processes["ur"], signal.SIGKILL)) < STANDS_S
        assert is_lost(arm) < LOST_S
        with pytest.raises(ConnectionLost, match="refused"):
            arm.connect()


# What leaves the connection as it is shares one. It comes last, as the controller has one program at a time.


def test_a_state_is_new_and_cheap(shared_arm: UR5e) -> None:
    ages, took, stamps = [], [], set()
    for _ in range(200):
        # Of the processor: what a busy machine takes away is not ours.
        begin = time.thread_time()
        state = shared_arm.state()
        took.append(time.thread_time() - begin)
        ages.append(time.monotonic() - state.t)
        stamps.add(state.t)
        time.sleep(0.004)
    assert min(ages) >= 0
    assert np.median(ages) < 0.02
    assert np.median(took) < 0.001
    # 125 packages a second.
    assert len(stamps) > 50


def test_a_second_client_only_watches(shared_arm: UR5e, caplog: pytest.LogCaptureFixture) -> None:
    with make_arm() as other:
        assert "a program is running" in caplog.text
        assert other.state().mode is ArmMode.NOT_READY
        with pytest.raises(DeviceFault, match="another program is on it"):
            start_descent(other)
    assert shared_arm.state().mode is ArmMode.READY
    go_home(shared_arm)


def test_stop_brakes_at_once(served: ServedCell, shared_arm: UR5e) -> None:
    start_descent(shared_arm)
    assert stands_after(served, shared_arm.stop) < STANDS_S
    finish(shared_arm)
    assert shared_arm.state().mode is ArmMode.READY
