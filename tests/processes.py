"""Whether processes that a test started are gone."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    from collections.abc import Iterable

_LIMIT_S = 30.0


def lives(pid: int) -> bool:
    """Whether a process runs; one that nobody has asked for its exit code yet does not."""
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def all_end(pids: Iterable[int]) -> bool:
    """Whether processes are gone within half a minute."""
    end = time.monotonic() + _LIMIT_S
    waiting = list(pids)
    while waiting and time.monotonic() < end:
        time.sleep(0.02)
        waiting = [pid for pid in waiting if lives(pid)]
    return not waiting
