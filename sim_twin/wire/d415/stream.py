"""The stream between a served camera and its clients, over TCP.

A client sends one `Request`; the server answers with a `Description` of the camera and then with frames as they are
taken. Each message is a magic number, its kind, the length of what follows, and that: JSON for the first two, numbers
and the two images for a frame. All numbers in network order, pixels of depth little-endian.
"""

from __future__ import annotations

import dataclasses
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from robotcell.errors import ConnectionLost
from sim_twin.d415.noise import DEPTH_UNIT_M
from sim_twin.d415.renderer import FRAMES_PER_S, SERIAL

if TYPE_CHECKING:
    import socket

    from robotcell.interfaces import Intrinsics

# One that current SDKs take.
_FIRMWARE = "5.15.1.55"
_MAGIC = b"D415"
_MESSAGE = struct.Struct("!4sBI")
# Width, height, and number and time of the depth image and of the colour image.
_FRAME = struct.Struct("!HHQdQd")
_REQUEST, _DESCRIPTION, _FRAME_KIND = 1, 2, 3
# The largest that a message of each kind can be: 1280x720 pixels of five bytes, and JSON with room to spare.
_LONGEST = {_REQUEST: 1000, _DESCRIPTION: 10_000, _FRAME_KIND: _FRAME.size + 1280 * 720 * 5}

# Of a frame: librealsense keeps it in 32 bits, with a sign.
_LAST_NUMBER = 2**31 - 1

_Text = Annotated[str, Field(min_length=1, max_length=100)]
_Side = Annotated[int, Field(ge=1, le=1280)]
_Positive = Annotated[float, Field(gt=0)]


class Reader(Protocol):
    """A stream of bytes, such as the `makefile("rb")` of a socket."""

    def readinto(self, buffer: memoryview, /) -> int | None:
        """Fill a buffer as far as possible; 0 at the end."""
        ...


class InTime:
    """Reads a connection until a time, however little comes at once.

    Args:
        connection: that is read.
        within_s: seconds from now.
    """

    def __init__(self, connection: socket.socket, within_s: float) -> None:
        self._connection = connection
        self._deadline = time.monotonic() + within_s

    def readinto(self, buffer: memoryview, /) -> int:
        """Fill a buffer as far as possible; 0 at the end.

        Raises:
            OSError: the connection is lost, or the time is over.
        """
        left_s = self._deadline - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("no whole message came in time")
        self._connection.settimeout(left_s)
        return self._connection.recv_into(buffer)


class _Json(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Request(_Json):
    """What a client wants to see: the mode of both streams, as `CameraMount.resolution`."""

    resolution: _Text


class Description(_Json):
    """The camera: what its device answers when asked, and the pinhole model of both images.

    Depth comes registered to the colour image: both streams have this model, and the same frame.
    """

    name: _Text
    serial: _Text
    firmware: _Text
    usb_type: _Text
    frames_per_s: Annotated[int, Field(ge=1, le=90)]
    depth_unit_m: _Positive
    width: _Side
    height: _Side
    fx: _Positive
    fy: _Positive
    cx: float
    cy: float


def describe(optics: Intrinsics, serial: str = SERIAL, usb_type: str = "3.2") -> Description:
    """The description of the twin's D415 in a mode with these intrinsics."""
    return Description(
        name="Intel RealSense D415",
        serial=serial,
        firmware=_FIRMWARE,
        usb_type=usb_type,
        frames_per_s=FRAMES_PER_S,
        depth_unit_m=DEPTH_UNIT_M,
        **dataclasses.asdict(optics),
    )


@dataclass(frozen=True)
class Image:
    """One image of one of the streams.

    Attributes:
        number: the stream's frame number.
        t: time of capture, seconds since the epoch.
        pixels: (H, W) uint16 in depth units, 0 = no return; or (H, W, 3) uint8 RGB.
    """

    number: int
    t: float
    pixels: npt.NDArray[np.uint16] | npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """A depth image and a colour image of the same size."""

    depth: Image
    color: Image


Message: TypeAlias = Request | Description | Frame


def encode(message: Message) -> bytes:
    """The bytes of a message."""
    if isinstance(message, Frame):
        height, width = message.depth.pixels.shape
        numbers = (message.depth.number, message.depth.t, message.color.number, message.color.t)
        parts: list[bytes | memoryview] = [
            _FRAME.pack(width, height, *numbers),
            np.ascontiguousarray(message.depth.pixels, "<u2").data,
            np.ascontiguousarray(message.color.pixels, np.uint8).data,
        ]
        return _join(_FRAME_KIND, parts)
    return _join(_REQUEST if isinstance(message, Request) else _DESCRIPTION, [message.model_dump_json().encode()])


def read_message(stream: Reader) -> Message:
    """The next message of a stream; its images refer to memory of their own.

    Raises:
        ConnectionLost: the stream ended, or carries something else.
    """
    magic, kind, length = _MESSAGE.unpack(_read(stream, _MESSAGE.size))
    if magic != _MAGIC or length > _LONGEST.get(kind, -1):
        raise ConnectionLost("the camera's stream carries no frames; is the address that of a served camera?")
    payload = _read(stream, length)
    try:
        if kind == _FRAME_KIND:
            return _frame(payload)
        return (Request if kind == _REQUEST else Description).model_validate_json(bytes(payload))
    except (ValidationError, ValueError, struct.error) as error:
        raise ConnectionLost(f"the camera's stream is damaged: {error}") from error


def _join(kind: int, parts: list[bytes | memoryview]) -> bytes:
    length = sum(memoryview(part).nbytes for part in parts)
    return b"".join([_MESSAGE.pack(_MAGIC, kind, length), *parts])


def _read(stream: Reader, length: int) -> bytearray:
    buffer = bytearray(length)
    view, done = memoryview(buffer), 0
    while done < length:
        count = stream.readinto(view[done:])
        if not count:
            raise ConnectionLost("the camera's stream ended")
        done += count
    return buffer


def _frame(payload: bytearray) -> Frame:
    width, height, depth_number, depth_t, color_number, color_t = _FRAME.unpack_from(payload)
    pixels = width * height
    if pixels == 0 or len(payload) != _FRAME.size + 5 * pixels:
        raise ValueError(f"a frame of {width}x{height} pixels cannot have {len(payload)} bytes")
    if not np.isfinite([depth_t, color_t]).all():
        raise ValueError("a frame has no time")
    if max(depth_number, color_number) > _LAST_NUMBER:
        raise ValueError("a frame has a number that no camera counts to")
    depth = np.frombuffer(payload, "<u2", pixels, _FRAME.size).reshape(height, width)
    color = np.frombuffer(payload, np.uint8, 3 * pixels, _FRAME.size + 2 * pixels).reshape(height, width, 3)
    return Frame(Image(depth_number, depth_t, depth), Image(color_number, color_t, color))
