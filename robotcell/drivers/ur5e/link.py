"""Between the driver of the UR5e and the child process in which ur_rtde runs: the messages, the record and the process.

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
from dataclasses import dataclass
from multiprocessing import Pipe
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

import numpy as np

from robotcell.errors import ConnectionLost
from robotcell.io.shared_record import SharedRecord, record_size

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

# Written by the child with every data package. `t`: time.monotonic() [s] of the measurement. `ready`: our program runs
# on the controller and was never interrupted. `stops`: how many stops were acted upon. `stopped_at`: time.monotonic()
# [s] at which a protective stop was first seen, 0 without one.
STATE = np.dtype(
    [
        ("t", "f8"),
        ("q", "f8", 6),
        ("qd", "f8", 6),
        ("tcp_pose", "f8", 6),
        ("tcp_force", "f8", 6),
        ("robot_mode", "i4"),
        ("safety_mode", "i4"),
        ("runtime_state", "i4"),
        ("speed_fraction", "f8"),
        ("ready", "u1"),
        ("moving", "u1"),
        ("stops", "u8"),
        ("stopped_at", "f8"),
    ]
)
# Written by the driver. `kicked`: time.monotonic() [s] of the last sign of life; `stops`: how many were asked for.
SUPERVISION = np.dtype([("kicked", "f8"), ("stops", "u8")])
# The second record stands behind the first.
SUPERVISION_OFFSET = record_size(STATE)

# ur_rtde needs up to 5 s to find that a controller does not start its program.
_SETUP_TIMEOUT_S = 8.0
_ANSWER_TIMEOUT_S = 0.8
_CLOSE_TIMEOUT_S = 1.5


@dataclass(frozen=True)
class Setup:
    """The first message to a child: what to connect to, and what to set there.

    Attributes:
        host: address of the controller.
        control: whether to start our program, or only to watch.
        tcp_offset: pose (6,) [m, rad] of the tool centre point on the flange.
        payload_kg: mass of the tool.
        payload_cog: (3,) [m] its centre of gravity, flange axes.
    """

    host: str
    control: bool
    tcp_offset: tuple[float, ...]
    payload_kg: float
    payload_cog: tuple[float, ...]


@dataclass(frozen=True)
class StartJoints:
    """Start a joint-space motion to q (6,) [rad]."""

    q: tuple[float, ...]
    speed_rad_s: float
    acceleration_rad_s2: float


@dataclass(frozen=True)
class StartLinear:
    """Start a straight motion of the tcp to a pose (6,) [m, rad]."""

    tcp_pose: tuple[float, ...]
    speed_m_s: float
    acceleration_m_s2: float


@dataclass(frozen=True)
class Close:
    """Stop the arm, end our program, and end."""


@dataclass(frozen=True)
class Answer:
    """What came of a message; `refusal` is "" if it was done."""

    refusal: str = ""


Request: TypeAlias = Setup | StartJoints | StartLinear | Close


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
        """Start a child; the next thing it waits for is a `Setup`."""
        ours, theirs = Pipe()
        # Memory and log have no name: whoever dies leaves nothing behind.
        with theirs, tempfile.TemporaryFile() as memory_file:
            log = tempfile.TemporaryFile()  # noqa: SIM115
            memory_file.truncate(SUPERVISION_OFFSET + record_size(SUPERVISION))
            memory = mmap.mmap(memory_file.fileno(), 0)
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
            raise ConnectionLost(self.epitaph()) from None
        raise ConnectionLost(f"the controller did not take a command within {timeout_s:g} s")

    def state(self) -> np.void:
        """The newest record.

        Raises:
            ConnectionLost: the child died.
        """
        if self._process.poll() is not None:
            raise ConnectionLost(self.epitaph())
        return self._state.read()

    def kick(self) -> None:
        """Tell the child that its supervisor is alive."""
        self._supervision.write(kicked=time.monotonic())

    def request_stop(self) -> int:
        """Ask for a stop, without waiting; the number that `STATE.stops` has when it was acted upon."""
        self._stops += 1
        self._supervision.write(stops=self._stops)
        return self._stops

    def epitaph(self) -> str:
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
