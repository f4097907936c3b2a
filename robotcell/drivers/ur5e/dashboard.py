"""The dashboard server of a UR controller: one line asked, one line answered, no wait without a bound."""

from __future__ import annotations

import socket
import time
from contextlib import suppress

from robotcell.errors import ConnectionLost

PORT = 29999
TIMEOUT_S = 1.0
_PIECE = 4096
# The longest answer of a dashboard has some hundred bytes.
_LONGEST_LINE = 1 << 16


class Dashboard:
    """A connection to the dashboard server of `host`."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._socket: socket.socket | None = None
        self._pending = b""

    def connect(self) -> None:
        """Connect and wait for the greeting.

        Raises:
            ConnectionLost: nothing listens, or it does not greet.
        """
        self.close()
        try:
            self._socket = socket.create_connection((self._host, PORT), TIMEOUT_S)
        except OSError as error:
            raise ConnectionLost(f"{self._host}:{PORT} (dashboard) cannot be reached: {error}", device="arm") from error
        greeting = self._line()
        if "Dashboard Server" not in greeting:
            raise ConnectionLost(
                f"{self._host}:{PORT} greets with {greeting!r}; a dashboard server is needed", device="arm"
            )

    def close(self) -> None:
        """Close the connection. Idempotent."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._pending = b""

    def ask(self, command: str) -> str:
        """Send a command and return the answer.

        Raises:
            ConnectionLost: no answer came.
        """
        self.send(command)
        return self._line()

    def send(self, command: str) -> None:
        """Send a command without waiting; its answer is passed over.

        Raises:
            ConnectionLost: it could not be sent.
        """
        connection = self._connection()
        try:
            connection.setblocking(False)
            with suppress(BlockingIOError):
                # Answers that nobody waited for.
                for _ in range(_LONGEST_LINE // _PIECE):
                    if not connection.recv(_PIECE):
                        break
            self._pending = b""
            connection.sendall(command.encode("ascii") + b"\n")
        except OSError as error:
            raise ConnectionLost(
                f"{self._host}:{PORT} (dashboard): the connection broke: {error}", device="arm"
            ) from error

    def _connection(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionLost(f"{self._host}:{PORT} (dashboard) is not connected", device="arm")
        return self._socket

    def _line(self) -> str:
        connection = self._connection()
        deadline = time.monotonic() + TIMEOUT_S
        while b"\n" not in self._pending:
            try:
                connection.settimeout(max(deadline - time.monotonic(), 0.001))
                more = connection.recv(_PIECE)
            except TimeoutError:
                raise ConnectionLost(
                    f"{self._host}:{PORT} (dashboard) did not answer within {TIMEOUT_S:g} s", device="arm"
                ) from None
            except OSError as error:
                raise ConnectionLost(
                    f"{self._host}:{PORT} (dashboard): the connection broke: {error}", device="arm"
                ) from error
            if not more:
                raise ConnectionLost(f"{self._host}:{PORT} (dashboard) closed the connection", device="arm")
            self._pending += more
            if b"\n" not in more and (len(self._pending) > _LONGEST_LINE or time.monotonic() > deadline):
                raise ConnectionLost(
                    f"{self._host}:{PORT} (dashboard) sends no line; a dashboard server is needed", device="arm"
                )
        line, _, self._pending = self._pending.partition(b"\n")
        return line.decode("utf-8", "replace").strip()
