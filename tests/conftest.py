"""Every test: repeatable examples, and nothing left behind."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from collections.abc import Iterator

# A runner in the background ignores SIGINT, and so would every process that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Examples are derived from the test itself, so a run is repeatable; a shared machine makes deadlines meaningless.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# pybullet numbers its clients from 0 and reuses the numbers of closed ones.
_CLIENT_IDS = range(64)


def _left_behind() -> dict[str, set[object]]:
    process = psutil.Process()
    pybullet = sys.modules.get("pybullet")
    return {
        "threads": set(threading.enumerate()),
        "processes": {child.pid for child in process.children(recursive=True)},
        "sockets": {connection.laddr for connection in process.net_connections()},
        "pybullet clients": {i for i in _CLIENT_IDS if pybullet.isConnected(i)} if pybullet else set(),
        "files in the working folder": {path.name for path in Path.cwd().iterdir() if not path.name.startswith(".")},
    }


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Fail a test that leaves a thread, a process, a socket, a pybullet client or a file."""
    before = _left_behind()
    yield
    # A thread that was told to end may need a moment.
    for thread in set(threading.enumerate()) - before["threads"]:
        thread.join(timeout=1)
    after = _left_behind()
    leaks = {kind: after[kind] - before[kind] for kind in before if after[kind] - before[kind]}
    assert not leaks, f"left behind: {leaks}"
