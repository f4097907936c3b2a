"""Something at the other end of a wire that says whatever a test wants it to."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Self


class HostileServer:
    """Sends each client the same bytes, once or for ever, whatever it asks; then it hangs up.

    `talk` and `endless` may be changed between clients.
    """

    def __init__(self, host: str, port: int = 0, talk: bytes = b"", *, endless: bool = False) -> None:
        self.talk = talk
        self.endless = endless
        self._listener = socket.create_server((host, port))
        self.port = int(self._listener.getsockname()[1])
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(OSError):
                client, _ = self._listener.accept()
                with client:
                    client.settimeout(0.2)
                    client.sendall(self.talk)
                    while self.endless and not self._ended.is_set():
                        client.sendall(self.talk)
                    client.shutdown(socket.SHUT_WR)
                    # Until the client has gone.
                    while client.recv(65536):
                        pass
