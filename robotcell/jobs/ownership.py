"""Whose job it is: by the lock that its process holds, and which ends with it."""

from __future__ import annotations

import enum
import socket
from typing import TYPE_CHECKING

from robotcell.io.lock_file import holder

if TYPE_CHECKING:
    from robotcell.io.lock_file import LockFile
    from robotcell.jobs.journal_tables import Job

_RUNNING = "running"


class Life(enum.Enum):
    """What becomes of a job whose row says that it runs."""

    RUNNING = "running"
    INTERRUPTED = "interrupted"  # its process has ended without a word
    ELSEWHERE = "running or interrupted on another computer"


def owner(lock: LockFile) -> str:
    """What a job's row says of the process that holds a lock."""
    return f"{socket.gethostname()}/{lock.token}"


def life(job: Job) -> Life | None:
    """Whether a job still runs; None for one that has ended.

    Raises:
        StorageError: the folder of the locks cannot be used.
    """
    if job.status != _RUNNING:
        return None
    if job.lock is None or job.owner is None:
        return Life.RUNNING
    host, _, token = job.owner.rpartition("/")
    if host != socket.gethostname():
        return Life.ELSEWHERE
    held_by = holder(job.lock)
    return Life.RUNNING if held_by is not None and held_by.token == token else Life.INTERRUPTED
