"""The unmodified ur_rtde against the served controller."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.addresses import loopback
from tests.sim_twin.wire.ur.stub_world import START_Q, ServedController

if TYPE_CHECKING:
    from collections.abc import Iterator

HOST = loopback(14)
LIMIT_S = 60


@pytest.fixture(scope="module")
def served() -> Iterator[ServedController]:
    # The client waits for it: 5 s, as on a real controller, are tested where time is simulated.
    with ServedController(HOST, unlock_after_s=2.0) as controller:
        yield controller


def calls(name: str) -> dict[str, Any]:
    """What the client got, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.sim_twin.wire.ur.ur_rtde_calls", HOST, name],
        stdout=subprocess.PIPE,
        timeout=LIMIT_S,
        check=True,
    )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_moves(served: ServedController) -> None:
    got = calls("moves")
    for name in ("moveJ", "moveL", "moveJ_IK", "moveL_FK", "begins", "ends", "steady", "path", "speedStop"):
        assert got[name] is True, name
    assert got["q"] == pytest.approx([0.3, *START_Q[1:]], abs=1e-6)
    assert got["raised"] == pytest.approx(0.05, abs=1e-6)
    assert got["lowered"] == pytest.approx(0.0, abs=1e-6)
    assert got["progress"] == 0
    assert 0.02 < got["stopped at"] < 0.9
    assert got["path end"] == pytest.approx(START_Q, abs=1e-6)
    assert {1, 2} <= set(got["way points"])
    assert got["servo"] == pytest.approx(0.0, abs=1e-3)
    assert got["speed"] == pytest.approx(0.05, abs=1e-3)


def test_questions_and_settings(served: ServedController) -> None:
    got = calls("questions")
    assert got["tcp"] == [0, 0, 0.2, 0, 0, 0]
    assert got["payload"] == [1.2, 0, 0, 0.05]
    for name in ("ik", "ik near"):
        np.testing.assert_allclose(got[name], START_Q, atol=1e-5)
    np.testing.assert_allclose(got["fk"], got["pose"], atol=1e-9)
    np.testing.assert_allclose(got["trans"], [0.1, 0.2, 0, 0, 0, 0], atol=1e-12)
    assert got["has"] == [True, False]
    assert got["within"] == [True, True]
    assert got["gives way"] == pytest.approx(-0.005, abs=1e-3)
    assert got["free"] == [True] * 4
    assert got["jog"] == [True, True]
    assert got["contact"] == [True, False, False]
    for name in ("setTcp", "setPayload", "zero", "force", "forceStop", "custom", "reupload", "third"):
        assert got[name] is True, name
    assert got["after"] == [True, [0.0] * 6]
    assert got["modes"][:3] == [7, 1, 2]
    assert got["modes"][3] & 0b11 == 0b11
    assert got["unreachable"] is False
    assert got["dead"] is False
    assert "already in use" in got["second"]
    assert "nonsense" in got["unknown"]


def test_outputs(served: ServedController) -> None:
    got = calls("outputs")
    assert got["set"] == [True] * 6
    assert got["bits"] == 1 << 1 | 1 << 10 | 1 << 16
    assert got["analog"] == pytest.approx(5.0)
    assert got["slider"] is True
    assert got["off"] is True


def test_stops_and_the_dashboard(served: ServedController) -> None:
    got = calls("stops")
    for name in ("paused", "resumed", "protective", "recovered", "kicked", "tripped", "off", "on"):
        assert got[name] is True, name
    assert got["state"] == [3, 4, False]
    assert got["refused"] is False
    assert "until 5s after" in got["early"]
    assert got["robotmode"] == "Robotmode: POWER_OFF"
    version, state, remote, serial, safety, running = got["words"]
    assert version.startswith("5.12.")
    assert state.startswith("STOPPED")
    assert remote is True
    assert serial.startswith("20")
    assert safety == "Safetymode: NORMAL"
    assert running is False


def test_the_arm_stands_when_its_client_is_killed(served: ServedController) -> None:
    client = subprocess.Popen(
        [sys.executable, "-m", "tests.sim_twin.wire.ur.ur_rtde_calls", HOST, "speeds"], stdout=subprocess.PIPE
    )
    try:
        assert client.stdout is not None
        while client.stdout.readline() != b"moving\n":
            pass
        at = served.q
        end = time.monotonic() + 5
        while np.abs(served.q - at).max() < 0.01:
            assert time.monotonic() < end, "the watchdog has stopped the client's program, or it never began"
            time.sleep(0.01)
    finally:
        client.kill()
        client.communicate()
    # The watchdog waits for 250 ms, and braking takes less than 50 ms.
    time.sleep(0.5)
    at = served.q
    time.sleep(0.2)
    np.testing.assert_array_equal(served.q, at)
