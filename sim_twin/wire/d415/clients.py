"""The TCP side of the served camera: for each client a thread that sends it whole frames or none."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading

from robotcell.errors import ConnectionLost
from sim_twin.wire.d415.stream import InTime, Request, read_message

_REQUEST_S = 2.0
# A megapixel frame takes 0.5 s through 100 Mbit/s.
_FRAME_S = 10.0


class Client:
    """One client. It gets what fits through its connection; what comes while it is still busy is dropped.

    Args:
        connection: of the client.
        request_s: how long it may take to say what it wants to see.
        frame_s: how long it may take to read a frame.
    """

    def __init__(self, connection: socket.socket, request_s: float = _REQUEST_S, frame_s: float = _FRAME_S) -> None:
        self.request: Request | None = None
        self.described = False
        self.gone = False
        self._connection = connection
        self._request_s, self._frame_s = request_s, frame_s
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
            message = read_message(InTime(self._connection, self._request_s))
            if not isinstance(message, Request):
                return
            # Of a whole message, however it is cut.
            self._connection.settimeout(self._frame_s)
            self.request = message
            while (waiting := self._outbox.get()) is not None:
                self._connection.sendall(waiting)
        except (OSError, ConnectionLost):
            pass  # the client left, or is none
        finally:
            self.gone = True
