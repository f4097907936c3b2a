"""A Modbus TCP server: frames, function codes 3, 6, 16 and 23, one connection, and faults of the link.

After "MODBUS Application Protocol V1.1b3" and "MODBUS Messaging on TCP/IP Implementation Guide V1.0b". It shares no
code with the client library of the driver, so that the two check each other.
"""

from __future__ import annotations

import asyncio
import enum
import random
import socket
import struct
import time
from typing import TYPE_CHECKING, Protocol, cast

if TYPE_CHECKING:
    from collections.abc import Sequence

_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), bytes that follow, unit
# Decided here; the real box may keep a silent client for ever.
_FIRST_REQUEST_S, _NEXT_REQUEST_S = 1.0, 60.0
# Of a client that does not read, so many bytes wait in the kernel, and so many responses for their time.
_SEND_BUFFER = 16 * 1024
_MOST_LATE_RESPONSES = 1000
_MAX_READ, _MAX_WRITE, _MAX_READ_WRITE = 125, 123, 121


class Refusal(enum.IntEnum):
    """Codes of exception responses."""

    FUNCTION = 1
    ADDRESS = 2
    VALUE = 3
    FAILURE = 4


class RefusedError(Exception):
    """A request is answered with an exception response.

    Args:
        code: of it.
    """

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Units(Protocol):
    """What stands behind the server."""

    def answers(self, unit: int) -> bool:
        """Whether there is a unit of that number; requests for others are met with silence."""
        ...

    def read(self, unit: int, address: int, count: int) -> list[int]:
        """Values 0..65535 of registers.

        Raises:
            RefusedError: with its code.
        """
        ...

    def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Set registers, all or none.

        Raises:
            RefusedError: with its code.
        """
        ...


def split_frames(data: bytearray) -> list[bytes]:
    """Take whole frames off the front of what was received.

    Raises:
        ValueError: it is no Modbus TCP.
    """
    frames = []
    while len(data) >= _HEADER.size:
        _, protocol, length, _ = _HEADER.unpack_from(data)
        if protocol != 0 or not 2 <= length <= 254:
            raise ValueError("not a Modbus TCP frame")
        if len(data) < 6 + length:
            break
        frames.append(bytes(data[: 6 + length]))
        del data[: 6 + length]
    return frames


def answer(frame: bytes, units: Units) -> bytes | None:
    """The response to a whole frame; None for silence."""
    transaction, _, _, unit = _HEADER.unpack_from(frame)
    request = frame[_HEADER.size :]
    if not units.answers(unit):
        return None
    try:
        response = _execute(request, unit, units)
    except RefusedError as refusal:
        response = bytes([request[0] | 0x80, refusal.code])
    return _HEADER.pack(transaction, 0, len(response) + 1, unit) + response


def _execute(request: bytes, unit: int, units: Units) -> bytes:
    function, body = request[0], request[1:]
    if function == 3:
        address, count = _unpack(">HH", body)
        return bytes([function]) + _read(unit, address, count, units)
    if function == 6:
        address, value = _unpack(">HH", body)
        units.write(unit, address, [value])
        return request
    if function == 16:
        address, count, _ = _unpack(">HHB", body[:5])
        units.write(unit, address, _values(body[4:], count, _MAX_WRITE))
        return request[:5]
    if function == 23:
        read_address, read_count, address, count, _ = _unpack(">HHHHB", body[:9])
        # Nothing is written when nothing can be read.
        _read(unit, read_address, read_count, units)
        units.write(unit, address, _values(body[8:], count, _MAX_READ_WRITE))
        return bytes([function]) + _read(unit, read_address, read_count, units)
    raise RefusedError(Refusal.FUNCTION)


def _read(unit: int, address: int, count: int, units: Units) -> bytes:
    if not 1 <= count <= _MAX_READ:
        raise RefusedError(Refusal.VALUE)
    return bytes([2 * count]) + struct.pack(f">{count}H", *units.read(unit, address, count))


def _values(data: bytes, count: int, most: int) -> tuple[int, ...]:
    """Registers behind their number of bytes."""
    if not 1 <= count <= most or data[0] != 2 * count:
        raise RefusedError(Refusal.VALUE)
    return _unpack(f">{count}H", data[1:])


def _unpack(layout: str, data: bytes) -> tuple[int, ...]:
    if struct.calcsize(layout) != len(data):
        raise RefusedError(Refusal.VALUE)
    return struct.unpack(layout, data)


class ModbusServer:
    """Serves units to one client at a time; further ones are let in and hung up on.

    A client that has been silent for longer than it may makes room for the next one.

    Args:
        units: that answer.
        host: address on which it listens.
        port: there; 0 for any.
        first_request_s: how long a client keeps its place without having asked for anything.
        next_request_s: how long after its last request.

    Attributes:
        silent: requests are taken and not answered.
        garbled: answers are bytes that mean nothing.
        refuses: every request is answered with this exception code.
        delay_s: answers come this much late.
    """

    def __init__(
        self,
        units: Units,
        host: str,
        port: int,
        first_request_s: float = _FIRST_REQUEST_S,
        next_request_s: float = _NEXT_REQUEST_S,
    ) -> None:
        self._units = units
        self.first_request_s = first_request_s
        self.next_request_s = next_request_s
        self._host = host
        self.port = port
        self._server: asyncio.Server | None = None
        self._client: _Client | None = None
        self._noise = random.Random(0)
        self.silent = False
        self.garbled = False
        self.refuses: int | None = None
        self.delay_s = 0.0

    async def open(self) -> None:
        """Listen. Does nothing when it does.

        Raises:
            OSError: the port cannot be had.
        """
        if self._server is None:
            loop = asyncio.get_running_loop()
            self._server = await loop.create_server(lambda: _Client(self), self._host, self.port)
            self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Hang up and listen no longer. Idempotent."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
            self.hang_up()
            await server.wait_closed()

    def hang_up(self) -> None:
        """Close the client's connection."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def let_in(self, client: _Client) -> bool:
        """Whether this is the one client."""
        if self._client is not None and self._client.silent:
            self.hang_up()
        if self._client is None or self._client.closing:
            self._client = client
        return self._client is client

    def respond(self, frame: bytes) -> bytes | None:
        """What goes back for a request, with the faults that there are."""
        if self.silent:
            return None
        if self.refuses is not None:
            unit, function = frame[6], frame[7]
            response: bytes | None = frame[:4] + struct.pack(">HBBB", 3, unit, function | 0x80, self.refuses)
        else:
            response = answer(frame, self._units)
        if self.garbled and response is not None:
            return self._noise.randbytes(len(response))
        return response


class _Client(asyncio.Protocol):
    """One connection."""

    def __init__(self, server: ModbusServer) -> None:
        self._server = server
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()
        # When it last sent a whole request, and what it may take until the next one; at first, when it came.
        self._heard_at = time.monotonic()
        self._may_be_silent_s = server.first_request_s
        # Responses that wait for their time, and whether those that were sent are being read.
        self._late = 0
        self._reads = True

    @property
    def closing(self) -> bool:
        """Whether the connection is, or is about to be, closed."""
        return self._transport is None or self._transport.is_closing()

    @property
    def silent(self) -> bool:
        """Whether it has asked for nothing for so long that it must make room."""
        return time.monotonic() - self._heard_at > self._may_be_silent_s

    def close(self) -> None:
        """Hang up."""
        if self._transport is not None:
            self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the connection, or hang up on a second one."""
        self._transport = cast("asyncio.Transport", transport)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        if not self._server.let_in(self):
            self.close()

    def connection_lost(self, _error: Exception | None) -> None:
        """Forget it."""
        self._transport = None

    def pause_writing(self) -> None:
        """Take no more requests from a client that does not read the responses."""
        self._reads = False
        self._take_turns()

    def resume_writing(self) -> None:
        """Go on when it reads them."""
        self._reads = True
        self._take_turns()

    def data_received(self, data: bytes) -> None:
        """Answer what is whole."""
        self._received += data
        try:
            frames = split_frames(self._received)
        except ValueError:
            self.close()
            return
        for frame in frames:
            self._heard_at, self._may_be_silent_s = time.monotonic(), self._server.next_request_s
            response = self._server.respond(frame)
            if response is not None:
                self._late += 1
                asyncio.get_running_loop().call_later(self._server.delay_s, self._send, response)
        self._take_turns()

    def _send(self, response: bytes) -> None:
        self._late -= 1
        if not self.closing and self._transport is not None:
            self._transport.write(response)
        self._take_turns()

    def _take_turns(self) -> None:
        """Listen to the client only as long as it reads, and not too many responses wait."""
        if self._transport is None or self._transport.is_closing():
            return
        if self._reads and self._late < _MOST_LATE_RESPONSES:
            self._transport.resume_reading()
        else:
            self._transport.pause_reading()
