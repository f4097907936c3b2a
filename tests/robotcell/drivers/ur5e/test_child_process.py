"""The child process of the arm's driver, without a controller."""

from __future__ import annotations

import tempfile
import time
from typing import TYPE_CHECKING

import pytest

from robotcell.drivers.ur5e.child_process import ChildProcess
from robotcell.drivers.ur5e.clock_offset import ClockOffset
from robotcell.drivers.ur5e.messages import Setup
from robotcell.errors import ConnectionLost, StorageError
from tests.addresses import loopback

if TYPE_CHECKING:
    from pathlib import Path


def test_a_disk_that_takes_no_file_is_a_storage_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "not there"))
    with pytest.raises(StorageError, match=r"make room.*TMPDIR") as refusal:
        ChildProcess.start()
    assert refusal.value.device == "arm"


def test_a_child_that_cannot_connect_ends_and_says_why() -> None:
    child = ChildProcess.start()
    try:
        setup = Setup(loopback(43), control=True, tcp_offset=(0.0,) * 6, payload_kg=0.0, payload_cog=(0.0,) * 3)
        with pytest.raises(ConnectionLost, match="ended with code 1"):
            child.ask(setup)
        with pytest.raises(ConnectionLost, match="ended with code 1"):
            child.state()
    finally:
        child.close()


def test_a_late_packet_is_as_old_as_its_time_stamp_says() -> None:
    offset = ClockOffset()
    first = offset.to_local(100.0)
    time.sleep(0.05)
    # It was measured 10 ms after the first, and came 50 ms after it.
    assert offset.to_local(100.01) == pytest.approx(first + 0.01, abs=1e-6)
