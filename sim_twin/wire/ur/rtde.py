"""RTDE as the server speaks it: one connection's protocol, bytes in and answers out.

Universal Robots, "Real-Time Data Exchange guide": every message is a size (with this header), a type and a payload, big
endian. Both protocol versions are spoken; a connection begins in version 1.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.controller import VERSION
from sim_twin.wire.ur.inputs import write_inputs
from sim_twin.wire.ur.variables import INPUTS, OUTPUTS, Recipe, split_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_twin.wire.ur.controller import Controller
    from sim_twin.wire.ur.snapshot import Snapshot

_HEADER = struct.Struct(">HB")
_PROTOCOL_VERSION, _CONTROLLER_VERSION = ord("V"), ord("v")
_OUTPUTS, _INPUTS = ord("O"), ord("I")
_START, _PAUSE, _DATA, _TEXT = ord("S"), ord("P"), ord("U"), ord("M")

_MAX_FREQUENCY = round(1 / PERIOD_S)
# Version 1 of the protocol cannot ask for a frequency.
_VERSION_1_FREQUENCY = 125
_MAX_RECIPES = 255
_WARNING = 2


class ProtocolError(Exception):
    """The bytes of a client cannot be RTDE; the controller closes the connection."""


class RtdeSession:
    """The server's side of one connection.

    Args:
        controller: that is read and written.
        claims: input variable -> the session that writes it, shared by all sessions.
        wrong: whether a fault of that name distorts the answers now.
    """

    def __init__(
        self,
        controller: Controller,
        claims: dict[str, RtdeSession],
        wrong: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._controller = controller
        self._claims = claims
        self._wrong = wrong
        self._buffer = bytearray()
        self._version = 1
        self._outputs: Recipe | None = None
        self._outputs_refused = False
        self._every = 1
        self._inputs: dict[int, Recipe] = {}
        self.streaming = False

    def feed(self, data: bytes) -> None:
        """Take bytes in, whole messages or not."""
        self._buffer += data

    def step(self) -> bytes | None:
        """Obey the next whole message; the answer to it, None when there is none.

        Raises:
            ProtocolError: a message is shorter than its own header.
        """
        if len(self._buffer) < _HEADER.size:
            return None
        size, kind = _HEADER.unpack_from(self._buffer)
        if size < _HEADER.size:
            raise ProtocolError(f"a message of {size} bytes")
        if len(self._buffer) < size:
            return None
        payload = bytes(self._buffer[_HEADER.size : size])
        del self._buffer[:size]
        return self._answer(kind, payload)

    def package(self, snapshot: Snapshot, tick: int) -> bytes | None:
        """The data package of a control period, None where this client gets none."""
        if not self.streaming or self._outputs is None or tick % self._every:
            return None
        data = self._outputs.pack([snapshot[name] for name in self._outputs.names])
        return _message(_DATA, data if self._version == 1 else b"\x01" + data)

    def close(self) -> None:
        """Let the inputs go."""
        self.streaming = False
        for name in [name for name, session in self._claims.items() if session is self]:
            del self._claims[name]

    def text(self, message: str, level: int = _WARNING) -> bytes:
        """A text message for this client; levels are 0 exception, 1 error, 2 warning, 3 information."""
        data = message.encode("latin-1", "replace")[:255]
        if self._version == 1:
            return _message(_TEXT, bytes([level]) + data)
        source = b"RTDE"
        return _message(_TEXT, bytes([len(data)]) + data + bytes([len(source)]) + source + bytes([level]))

    def _answer(self, kind: int, payload: bytes) -> bytes:
        handlers: dict[int, Callable[[bytes], bytes]] = {
            _PROTOCOL_VERSION: self._negotiate,
            _CONTROLLER_VERSION: lambda _: _message(_CONTROLLER_VERSION, struct.pack(">4I", *VERSION)),
            _OUTPUTS: self._set_up_outputs,
            _INPUTS: self._set_up_inputs,
            _START: self._start,
            _PAUSE: self._pause,
            _DATA: self._take,
            _TEXT: lambda _: b"",
        }
        handler = handlers.get(kind)
        return self.text(f"a message of type {kind} is not understood") if handler is None else handler(payload)

    def _start(self, _: bytes) -> bytes:
        self.streaming = not self._outputs_refused
        return _message(_START, bytes([self.streaming]))

    def _pause(self, _: bytes) -> bytes:
        self.streaming = False
        return _message(_PAUSE, b"\x01")

    def _negotiate(self, payload: bytes) -> bytes:
        version = int.from_bytes(payload, "big") if len(payload) == 2 else 0
        accepted = version in (1, 2) and not self._wrong("version")
        if accepted:
            self._version = version
        return _message(_PROTOCOL_VERSION, bytes([accepted]))

    def _set_up_outputs(self, payload: bytes) -> bytes:
        frequency: float = _VERSION_1_FREQUENCY
        if self._version == 2:
            if len(payload) < 8:
                return self.text("the request for outputs has no frequency")
            (frequency,) = struct.unpack_from(">d", payload)
            payload = payload[8:]
        names = split_names(payload)
        types = [OUTPUTS.get(name, "NOT_FOUND") for name in names] or ["NOT_FOUND"]
        if self._wrong("not_found"):
            types[-1] = "NOT_FOUND"
        self._outputs_refused = "NOT_FOUND" in types or not (math.isfinite(frequency) and frequency > 0)
        self._outputs = None if self._outputs_refused else Recipe(names, types)
        self._every = max(1, round(_MAX_FREQUENCY / frequency)) if not self._outputs_refused else 1
        answer = ",".join(types).encode()
        if self._version == 1:
            return _message(_OUTPUTS, answer)
        return _message(_OUTPUTS, bytes([not self._outputs_refused]) + answer)

    def _set_up_inputs(self, payload: bytes) -> bytes:
        names = split_names(payload)
        types = [self._input_type(name) for name in names] or ["NOT_FOUND"]
        # Recipes are numbered in the order of the requests; 0 stands for one that is refused.
        number = len(self._inputs) + 1
        if {"NOT_FOUND", "IN_USE"} & set(types) or number > _MAX_RECIPES:
            return _message(_INPUTS, b"\x00" + ",".join(types).encode())
        self._claims.update(dict.fromkeys(names, self))
        self._inputs[number] = Recipe(names, types)
        return _message(_INPUTS, bytes([number]) + ",".join(types).encode())

    def _input_type(self, name: str) -> str:
        if name not in INPUTS:
            return "NOT_FOUND"
        if self._wrong("in_use") or self._claims.get(name, self) is not self:
            return "IN_USE"
        return INPUTS[name]

    def _take(self, payload: bytes) -> bytes:
        recipe = self._inputs.get(payload[0]) if payload else None
        if recipe is None or len(payload) != 1 + recipe.size:
            return self.text("an input package does not fit its recipe")
        write_inputs(self._controller, recipe.unpack(payload[1:]))
        self._controller.wrote(recipe.names)
        return b""


def _message(kind: int, payload: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload
