"""One process of a served cell: its start, its two pipes, and its end."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any

from robotcell.errors import ConfigError, ConnectionLost

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_twin.wire.faults import Fault

# Ten objects are built in half a second; a busy machine may need many times that to import everything.
_START_S = 90.0
_END_S = 5.0


class ServerProcess:
    """A process that serves until it is terminated, or until its supervisor is gone.

    Args:
        name: for messages.
        entry: what it runs; called with `arguments`, a pipe for lists of `Fault`, and one for what it says once it is
            ready (or {"error": text}).
        arguments: of `entry`.
        realtime: goes ahead of everything else on the computer, where the system allows it.
    """

    def __init__(self, name: str, entry: Callable[..., None], *arguments: object, realtime: bool = False) -> None:
        self._name = name
        context = multiprocessing.get_context("spawn")
        faults, self._faults = context.Pipe(duplex=False)
        self._ready, ready = context.Pipe(duplex=False)
        # A daemon: a supervisor that ends without closing the cell does not wait for it.
        self._process = context.Process(
            target=entry, args=(*arguments, faults, ready), name=f"robotcell twin {name}", daemon=True
        )
        # An interrupt at the terminal reaches the whole group; it is for the supervisor alone, from the first moment.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if realtime and self._process.pid is not None and sys.platform == "linux":
            with contextlib.suppress(OSError):
                os.sched_setscheduler(self._process.pid, os.SCHED_RR, os.sched_param(10))
        # The child's ends are the child's alone, so that each side sees when the other is gone.
        faults.close()
        ready.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid or -1

    @property
    def alive(self) -> bool:
        """Whether it is there."""
        return self._process.is_alive()

    def wait_until_ready(self) -> dict[str, Any]:
        """What the process says once it is ready.

        Raises:
            ConfigError: it cannot serve what it was given; the words are its own.
            ConnectionLost: it died, or did not get ready.
        """
        if not wait([self._ready, self._process.sentinel], _START_S):
            raise ConnectionLost(f"the twin's process {self._name!r} was not ready after {_START_S:.0f} s")
        try:
            answer: dict[str, Any] = self._ready.recv()
        except EOFError:
            self._process.join(_END_S)
            raise ConnectionLost(
                f"the twin's process {self._name!r} died at its start (exit code {self._process.exitcode})"
            ) from None
        if "error" in answer:
            raise ConfigError(f"the cell cannot be served: {answer['error']}")
        return answer

    def send_faults(self, faults: tuple[Fault, ...]) -> None:
        """Let it have these faults. One that has died needs none."""
        with contextlib.suppress(OSError):
            self._faults.send(faults)

    def terminate(self) -> None:
        """Tell it to end."""
        self._process.terminate()

    def close(self) -> None:
        """Wait until it has ended, and kill it when that takes too long."""
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()
        self._faults.close()
        self._ready.close()
