"""An RTDE client from the public protocol alone: every call is bounded by the socket's timeout."""

from __future__ import annotations

import contextlib
import socket
import struct
from typing import TYPE_CHECKING

from sim_twin.wire.ur.variables import Recipe

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Self

    from sim_twin.wire.ur.variables import Value


class RtdeClient:
    """One connection to port 30004."""

    def __init__(self, host: str, timeout: float = 2.0) -> None:
        self._socket = socket.create_connection((host, 30004), timeout=timeout)
        self._buffer = b""
        self._outputs: Recipe | None = None
        self._inputs: dict[int, Recipe] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()

    def settimeout(self, timeout: float) -> None:
        self._socket.settimeout(timeout)

    def send(self, kind: str, payload: bytes = b"") -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def message(self) -> tuple[str, bytes]:
        """The next message, of any kind."""
        while len(self._buffer) < 3 or len(self._buffer) < struct.unpack_from(">H", self._buffer)[0]:
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionError("closed")
            self._buffer += data
        size, kind = struct.unpack_from(">HB", self._buffer)
        payload, self._buffer = self._buffer[3:size], self._buffer[size:]
        return chr(kind), payload

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """A request's answer; data packages on the way are left out."""
        self.send(kind, payload)
        while True:
            answer, data = self.message()
            if answer == kind:
                return data

    def negotiate(self, version: int = 2) -> bool:
        return self.ask("V", struct.pack(">H", version)) == b"\x01"

    def outputs(self, names: Sequence[str], frequency: float = 500.0) -> list[str]:
        answer = self.ask("O", struct.pack(">d", frequency) + ",".join(names).encode())
        types = answer[1:].decode().split(",")
        if answer[0]:
            self._outputs = Recipe(names, types)
        return types

    def inputs(self, names: Sequence[str]) -> tuple[int, list[str]]:
        answer = self.ask("I", ",".join(names).encode())
        types = answer[1:].decode().split(",")
        if answer[0]:
            self._inputs[answer[0]] = Recipe(names, types)
        return answer[0], types

    def write(self, recipe: int, *values: Value) -> None:
        self.send("U", bytes([recipe]) + self._inputs[recipe].pack(values))

    def start(self) -> bool:
        return self.ask("S") == b"\x01"

    def pause(self) -> bool:
        return self.ask("P") == b"\x01"

    def package(self) -> dict[str, Value]:
        """The next data package."""
        assert self._outputs is not None
        while True:
            kind, payload = self.message()
            if kind == "U":
                assert payload[0] == 1
                return dict(self._outputs.unpack(payload[1:]))

    def newest(self) -> dict[str, Value]:
        """The last data package that has come by now."""
        self._socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._buffer += self._socket.recv(65536)
        self._socket.settimeout(2.0)
        package = self.package()
        while len(self._buffer) >= 3 and len(self._buffer) >= struct.unpack_from(">H", self._buffer)[0]:
            package = self.package()
        return package


@contextlib.contextmanager
def reading(host: str, *names: str, frequency: float = 500.0) -> Iterator[RtdeClient]:
    """A client that receives these variables."""
    with RtdeClient(host) as client:
        assert client.negotiate()
        assert "NOT_FOUND" not in client.outputs(names, frequency)
        assert client.start()
        yield client
