"""A small reader of Universal Robots' RTDE protocol (version 2) that never waits longer than it was told.

The driver moves the arm by ur_rtde. This reader only looks: before ur_rtde is let near a controller that may be
silent, and for the doctor. Protocol: Universal Robots, "Real-Time Data Exchange (RTDE) guide".
"""

from __future__ import annotations

import socket
import struct
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

from robotcell.errors import ConnectionLost

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

PORT = 30004
# How long a controller may take for an answer, or for its next data package.
TIMEOUT_S = 1.0
# Before an answer, at most so many data packages and texts come: a stream of 500 Hz has 500 in the time of an answer.
_MOST_PASSED_OVER = 1000

_HEADER = struct.Struct(">HB")
_VERSION, _CONTROLLER_VERSION, _OUTPUTS, _INPUTS, _START, _DATA, _TEXT = 86, 118, 79, 73, 83, 85, 77
_FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

Value: TypeAlias = "float | tuple[float, ...]"


def as_number(value: Value) -> float:
    """The value of a variable that holds one number."""
    return value[0] if isinstance(value, tuple) else value


def as_vector(value: Value) -> tuple[float, ...]:
    """The value of a variable that holds several numbers."""
    return value if isinstance(value, tuple) else (value,)


@contextmanager
def open_rtde(host: str) -> Iterator[RtdeReader]:
    """Connect to a controller and agree on the protocol.

    Raises:
        ConnectionLost: nothing listens, nothing answers, or what answers does not speak RTDE.
    """
    try:
        connection = socket.create_connection((host, PORT), TIMEOUT_S)
    except OSError as error:
        raise ConnectionLost(f"{host}:{PORT} (RTDE) cannot be reached: {error}", device="arm") from error
    with connection:
        yield RtdeReader(host, connection)


class RtdeReader:
    """An open RTDE connection; `version` is the controller's: major, minor, bugfix, build."""

    def __init__(self, host: str, connection: socket.socket) -> None:
        self._host = host
        self._socket = connection
        self._pending = b""
        self._layout: list[tuple[str, struct.Struct]] = []
        if self._ask(_VERSION, struct.pack(">H", 2)) != b"\x01":
            raise self._wrong("it does not speak version 2 of the protocol")
        answer = self._ask(_CONTROLLER_VERSION)
        if len(answer) != 16:
            raise self._wrong("its version is not four numbers")
        self.version: tuple[int, int, int, int] = struct.unpack(">4I", answer)

    def claim_inputs(self, names: Sequence[str]) -> list[str]:
        """Claim input registers until the connection ends; those of them that another client or fieldbus holds."""
        types = self._types(self._ask(_INPUTS, ",".join(names).encode()), len(names))
        return [name for name, kind in zip(names, types, strict=True) if kind == "IN_USE"]

    def start(self, names: Sequence[str], frequency_hz: float) -> None:
        """Ask for output variables at a rate."""
        types = self._types(self._ask(_OUTPUTS, struct.pack(">d", frequency_hz) + ",".join(names).encode()), len(names))
        unknown = [name for name, kind in zip(names, types, strict=True) if kind not in _FORMATS]
        if unknown:
            raise self._wrong(f"it does not know {', '.join(unknown)}")
        self._layout = [(name, struct.Struct(">" + _FORMATS[kind])) for name, kind in zip(names, types, strict=True)]
        if self._ask(_START) != b"\x01":
            raise self._wrong("it refuses to send data")

    def read(self) -> dict[str, Value]:
        """The next data package."""
        payload = self._receive(_DATA)
        if len(payload) != 1 + sum(layout.size for _, layout in self._layout):
            raise self._wrong(f"a data package has {len(payload)} bytes")
        values: dict[str, Value] = {}
        offset = 1
        for name, layout in self._layout:
            numbers = layout.unpack_from(payload, offset)
            values[name] = numbers if len(numbers) > 1 else numbers[0]
            offset += layout.size
        return values

    def _types(self, answer: bytes, count: int) -> list[str]:
        types = answer[1:].decode("ascii", "replace").split(",")
        if len(types) != count:
            raise self._wrong(f"it gives {len(types)} types for {count} variables")
        return types

    def _ask(self, kind: int, payload: bytes = b"") -> bytes:
        try:
            self._socket.sendall(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)
        except OSError as error:
            raise self._wrong(f"the connection broke: {error}") from error
        return self._receive(kind)

    def _receive(self, wanted: int) -> bytes:
        """The payload of the next message of a kind; what else comes is passed over."""
        deadline = time.monotonic() + TIMEOUT_S
        for _ in range(_MOST_PASSED_OVER):
            size, kind = _HEADER.unpack(self._take(_HEADER.size, deadline))
            if size < _HEADER.size:
                raise self._wrong("it answers with something that is not RTDE")
            payload = self._take(size - _HEADER.size, deadline)
            if kind == wanted:
                return payload
            if kind not in (_TEXT, _DATA):
                raise self._wrong(f"it answers with a message of kind {kind}")
        raise self._wrong(f"it sends {_MOST_PASSED_OVER} messages and not the one that it was asked for")

    def _take(self, count: int, deadline: float) -> bytes:
        while len(self._pending) < count:
            try:
                self._socket.settimeout(max(deadline - time.monotonic(), 0.001))
                more = self._socket.recv(65536)
            except TimeoutError:
                raise self._wrong(f"it sent nothing for {TIMEOUT_S:g} s") from None
            except OSError as error:
                raise self._wrong(f"the connection broke: {error}") from error
            if not more:
                raise self._wrong("it closed the connection")
            if time.monotonic() > deadline and len(self._pending) + len(more) < count:
                raise self._wrong(f"it sent no whole message for {TIMEOUT_S:g} s")
            self._pending += more
        taken, self._pending = self._pending[:count], self._pending[count:]
        return taken

    def _wrong(self, what: str) -> ConnectionLost:
        return ConnectionLost(f"{self._host}:{PORT} (RTDE): {what}", device="arm")
