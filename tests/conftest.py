"""Every test: repeatable examples, and nothing left behind."""

from __future__ import annotations

import os
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

# Processes that tests start need not compile again what one of them has compiled, whatever the machine's habits are.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Examples are derived from the test itself, so a run is repeatable: what a further run would add are the same ones. A
# shared machine makes deadlines meaningless.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=60)
settings.load_profile("repeatable")

# pybullet numbers its clients from 0 and reuses the numbers of closed ones.
_CLIENT_IDS = range(64)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the contract suite on a real cell."""
    group = parser.getgroup("robotcell", "a real cell")
    group.addoption("--cell-file", help="cell.toml of the real cell on which `-m hardware` states the contract")
    group.addoption(
        "--i-stand-at-the-emergency-stop",
        action="store_true",
        help="needed with --cell-file: the arm moves up to 0.35 rad from home, and the fingers open and close",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Nothing moves a real arm by accident."""
    if config.getoption("cell_file") is not None and not config.getoption("i_stand_at_the_emergency_stop"):
        raise pytest.UsageError(
            "the cell of --cell-file will move: clear the table and the space around the arm, take the arm near home, "
            "stand at the emergency stop, and say so by --i-stand-at-the-emergency-stop"
        )


def _children(process: psutil.Process) -> set[int]:
    """All processes below one. Linux lists the children of a thread; psutil looks at every process of the machine."""
    children: set[int] = set()
    pending = [process.pid]
    try:
        while pending:
            for task in Path(f"/proc/{pending.pop()}/task").iterdir():
                found = {int(pid) for pid in (task / "children").read_text().split()}
                children |= found
                pending.extend(found)
    except OSError:  # not Linux, or something ended meanwhile
        return {child.pid for child in process.children(recursive=True)}
    return children


def _left_behind() -> dict[str, set[object]]:
    process = psutil.Process()
    pybullet = sys.modules.get("pybullet")
    return {
        "threads": set(threading.enumerate()),
        "processes": _children(process),
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
