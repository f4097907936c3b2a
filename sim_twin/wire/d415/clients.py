"""The TCP side of the served camera: for each client a thread that sends it whole frames or none."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading

from robotcell.errors import ConnectionLost
from sim_twin.wire.d415.stream import Request, read_message

_REQUEST_TIMEOUT_S = 2.0


class Client:
    """One client. It gets what fits through its connection; what comes while it is still busy is dropped."""

    def __init__(self, connection: socket.socket) -> None:
        self.request: Request | None = None
        self.described = False
        self.gone = False
        self._connection = connection
        self._outbox: queue.Queue[bytes | None] = queue.Queue(maxsize=1)
        self._thread = threading.Thread(target=self._serve, name="camera client", daemon=True)
        self._thread.start()

    def offer(self, message: bytes) -> bool:
        """Send a message unless the last one is still waiting; whether it will be sent. Never waits."""
        try:
            self._outbox.put_nowait(message)
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """End the connection. Idempotent."""
        with contextlib.suppress(OSError):  # the client was faster
            self._connection.shutdown(socket.SHUT_RDWR)
        # A thread that waits for a message ends with this one; one that sends meets the end of the connection.
        with contextlib.suppress(queue.Full):
            self._outbox.put_nowait(None)
        self._thread.join()
        self._connection.close()

    def _serve(self) -> None:
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connection.settimeout(_REQUEST_TIMEOUT_S)
            with self._connection.makefile("rb") as stream:
                message = read_message(stream)
            if not isinstance(message, Request):
                return
            self._connection.settimeout(None)
            self.request = message
            while (waiting := self._outbox.get()) is not None:
                self._connection.sendall(waiting)
        except (OSError, ConnectionLost):
            pass  # the client left, or is none
        finally:
            self.gone = True
