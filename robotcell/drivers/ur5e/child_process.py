"""The child process in which ur_rtde runs, as the driver of the UR5e sees it.

ur_rtde can block for minutes, segfault or abort when a controller drops, stalls or sends garbage. Nothing here waits
for the child longer than a bound, whatever has become of it.
"""

from __future__ import annotations

import mmap
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from multiprocessing import Pipe
from typing import TYPE_CHECKING, BinaryIO

from robotcell.drivers.ur5e.messages import STATE, SUPERVISION, SUPERVISION_OFFSET, Answer, Close, Setup
from robotcell.errors import ConnectionLost, StorageError
from robotcell.io.shared_record import SharedRecord, record_size

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    import numpy as np

    from robotcell.drivers.ur5e.messages import Request

# ur_rtde needs up to 5 s to find that a controller does not start its program.
_SETUP_TIMEOUT_S = 8.0
_ANSWER_TIMEOUT_S = 0.8
_CLOSE_TIMEOUT_S = 1.5


class ChildProcess:
    """The child of one connection. Made by `start`; it ends with `close`, with `kill`, or with this process."""

    def __init__(self, process: subprocess.Popen[bytes], pipe: Connection, memory: mmap.mmap, log: BinaryIO) -> None:
        self._process = process
        self._pipe = pipe
        self._memory = memory
        self._log = log
        self._state = SharedRecord(STATE, memory)
        self._supervision = SharedRecord(SUPERVISION, memory, SUPERVISION_OFFSET)
        self._stops = 0

    @classmethod
    def start(cls) -> ChildProcess:
        """Start a child; the next thing it waits for is a `Setup`.

        Raises:
            StorageError: the folder for temporary files takes none.
        """
        with _temporary_file(SUPERVISION_OFFSET + record_size(SUPERVISION)) as memory_file:
            log = _temporary_file()
            memory = mmap.mmap(memory_file.fileno(), 0)
            ours, theirs = Pipe()
            with theirs:
                fds = theirs.fileno(), memory_file.fileno()
                process = subprocess.Popen(
                    [sys.executable, "-m", "robotcell.drivers.ur5e.child", *map(str, fds)],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=fds,
                    # An interrupt at the terminal is ours to handle: the child goes on until the arm stands.
                    start_new_session=True,
                )
        return cls(process, ours, memory, log)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def ask(self, request: Request) -> Answer:
        """Send a request and wait for its answer.

        Raises:
            ConnectionLost: the child died or does not answer.
        """
        timeout_s = _SETUP_TIMEOUT_S if isinstance(request, Setup) else _ANSWER_TIMEOUT_S
        try:
            self._pipe.send(request)
            if self._pipe.poll(timeout_s):
                answer: Answer = self._pipe.recv()
                return answer
        except (OSError, EOFError):
            raise ConnectionLost(self.how_it_ended(), device="arm") from None
        raise ConnectionLost(f"the controller did not take a command within {timeout_s:g} s", device="arm")

    def state(self) -> np.void:
        """The newest record.

        Raises:
            ConnectionLost: the child died.
        """
        if self._process.poll() is not None:
            raise ConnectionLost(self.how_it_ended(), device="arm")
        return self._state.read()

    def kick(self) -> None:
        """Tell the child that its supervisor is alive."""
        self._supervision.write(kicked=time.monotonic())

    def request_stop(self) -> int:
        """Ask for a stop, without waiting; the number that `STATE.stops` has when it was acted upon."""
        self._stops += 1
        self._supervision.write(stops=self._stops)
        return self._stops

    def how_it_ended(self) -> str:
        """Words for a child that died: by which signal, and what it said last."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2)
        code = self._process.returncode
        if code is None:
            return "the process that talks to the controller closed its pipe"
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        self._log.seek(0)
        said = self._log.read().decode("utf-8", "replace").strip().splitlines()
        return f"the process that talks to the controller {how}" + (f": {said[-1].strip()}" if said else "")

    def close(self) -> None:
        """Let the child stop the arm and end; kill it if it does not. Idempotent."""
        with suppress(OSError):
            self._pipe.send(Close())
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_TIMEOUT_S)
        self.kill()

    def kill(self) -> None:
        """End the child at once. Idempotent."""
        self._process.kill()
        self._process.wait()
        self._pipe.close()
        self._log.close()


def _temporary_file(size: int = 0) -> BinaryIO:
    """A file of zeros without a name, so that whoever dies leaves nothing behind.

    Raises:
        StorageError: it cannot be written.
    """
    try:
        # Written, not only made longer: a full disk is found here, and not when the memory is used.
        file: BinaryIO = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        file.write(bytes(size))
    except OSError as error:
        raise StorageError(
            f"the arm's driver cannot write a temporary file ({error}): make room in the folder for temporary files, "
            "or name another one by TMPDIR",
            device="arm",
        ) from error
    return file
