"""One process at a time: a lock that ends with the process that holds it, and that tells who this is.

The kernel keeps the lock, on a file in a folder of the user, so a holder that was killed has let go of it. The file
itself stays: a file that came and went would let two processes each lock their own.
"""

from __future__ import annotations

import fcntl
import getpass
import json
import os
import re
import socket
import sys
import tempfile
import time
import uuid
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path

from robotcell.errors import StorageError

# Who asks whether a lock is held has it for a moment; a lock that is held for longer is somebody's.
_ASKED_S = 0.3
_AGAIN_S = 0.01


@dataclass(frozen=True)
class Holder:
    """A process that holds a lock.

    Attributes:
        token: of this one time that the lock is held; no other has it.
        pid: of the process.
        host: name of its computer.
        user: whose process it is.
        command: by which it was started.
        since: when it took the lock, UTC, ISO 8601, to the second.
    """

    token: str
    pid: int
    host: str
    user: str
    command: str
    since: str

    def __str__(self) -> str:
        """In words."""
        return f"{self.command!r} (process {self.pid} of {self.user} on {self.host}, since {self.since})"


class LockFile:
    """The lock of a name.

    Args:
        name: of what is locked.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.token = uuid.uuid4().hex
        self._file: int | None = None

    def acquire(self) -> Holder | None:
        """Take the lock; None, or who holds it. Does nothing when it is ours.

        Raises:
            StorageError: the folder of the locks cannot be used.
        """
        if self._file is not None:
            return None
        path = _path(self.name)
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise StorageError(f"{path} cannot be opened: {error.strerror}; check its folder") from error
        try:
            deadline = time.monotonic() + _ASKED_S
            while not _try_lock(file, fcntl.LOCK_EX):
                if time.monotonic() > deadline:
                    return _read(file)
                time.sleep(_AGAIN_S)
            _write(file, _ourselves(self.token))
        except OSError as error:
            raise StorageError(f"{path} cannot be written: {error.strerror}; check its folder and the disk") from error
        else:
            self._file, file = file, -1
        finally:
            if file >= 0:
                os.close(file)
        return None

    def release(self, *, forget: bool = False) -> None:
        """Let go. Idempotent.

        Args:
            forget: remove the file too; only for a name that nobody else ever locks.
        """
        if self._file is None:
            return
        if forget:
            with suppress(OSError, StorageError):
                _path(self.name).unlink()
        os.close(self._file)
        self._file = None


def holder(name: str) -> Holder | None:
    """Who holds the lock of a name now; None for nobody.

    Raises:
        StorageError: the folder of the locks cannot be used.
    """
    path = _path(name)
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StorageError(f"{path} cannot be opened: {error.strerror}; check its folder") from error
    try:
        return None if _try_lock(file, fcntl.LOCK_SH) else _read(file)
    finally:
        os.close(file)


def lock_folder() -> Path:
    """The folder of the locks of this user, made where it is missing.

    Raises:
        StorageError: it cannot be made, or is another user's.
    """
    run = Path(os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}")
    folder = run / "robotcell" if run.is_dir() else Path(tempfile.gettempdir()) / f"robotcell-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise StorageError(f"{folder} cannot be made: {error.strerror}; check the folder above it") from error
    if found.st_uid != os.getuid() or folder.is_symlink():
        raise StorageError(f"{folder} is not yours: remove it, or set XDG_RUNTIME_DIR to a folder of your own")
    return folder


def _path(name: str) -> Path:
    return lock_folder() / f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)}.lock"


def _try_lock(file: int, kind: int) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _ourselves(token: str) -> Holder:
    words = [Path(sys.argv[0]).name or "python", *sys.argv[1:]]
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        user = str(os.getuid())
    since = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Holder(token, os.getpid(), socket.gethostname(), user, " ".join(words)[:200], since)


def _write(file: int, ours: Holder) -> None:
    line = json.dumps(asdict(ours)).encode() + b"\n"
    # Whoever reads meanwhile finds a whole first line at all times.
    os.pwrite(file, line, 0)
    os.ftruncate(file, len(line))


def _read(file: int) -> Holder:
    line = os.pread(file, 4096, 0).partition(b"\n")[0]
    try:
        return Holder(**json.loads(line))
    except (ValueError, TypeError):
        # It has just been made, and its holder is about to write who it is.
        return Holder("", 0, "this computer", "an unknown user", "an unknown command", "just now")
