"""The protocol of the camera's frames, both ends."""

import io

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robotcell.errors import ConnectionLost
from sim_twin.d415.renderer import MODES
from sim_twin.wire.d415.stream import Frame, Image, Request, describe, encode, read_message

NUMBERS = st.integers(0, 2**31 - 1)
TIMES = st.floats(0, 4e9)


class Dribble:
    """A stream that gives a few bytes at a time, as a network may."""

    def __init__(self, data, portion):
        self._stream = io.BytesIO(data)
        self._portion = portion

    def readinto(self, buffer):
        return self._stream.readinto(buffer[: self._portion])


@st.composite
def frames(draw):
    height, width = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    depth = draw(hnp.arrays(np.uint16, (height, width)))
    color = draw(hnp.arrays(np.uint8, (height, width, 3)))
    return Frame(Image(draw(NUMBERS), draw(TIMES), depth), Image(draw(NUMBERS), draw(TIMES), color))


def assert_same(a, b):
    for one, other in ((a.depth, b.depth), (a.color, b.color)):
        assert (one.number, one.t) == (other.number, other.t)
        assert one.pixels.dtype == other.pixels.dtype
        np.testing.assert_array_equal(one.pixels, other.pixels)


@given(st.lists(frames(), min_size=1, max_size=3), st.integers(1, 40))
def test_frames_arrive_as_they_were_sent(sent, portion):
    stream = Dribble(b"".join(map(encode, sent)), portion)
    for frame in sent:
        assert_same(read_message(stream), frame)
    with pytest.raises(ConnectionLost, match="ended"):
        read_message(stream)


@given(frames())
def test_what_is_not_in_order_in_memory_is_put_in_order(frame):
    turned = Frame(
        Image(frame.depth.number, frame.depth.t, np.asfortranarray(frame.depth.pixels)),
        Image(frame.color.number, frame.color.t, frame.color.pixels[:, ::-1][:, ::-1]),
    )
    assert encode(turned) == encode(frame)


@pytest.mark.parametrize("message", [Request(resolution="640x480"), *(describe(optics) for optics in MODES.values())])
def test_requests_and_descriptions_arrive_as_they_were_sent(message):
    assert read_message(io.BytesIO(encode(message))) == message


@given(st.binary(max_size=300))
def test_bytes_that_mean_nothing_are_refused(data):
    with pytest.raises(ConnectionLost):
        read_message(io.BytesIO(data))


FRAME = encode(Frame(Image(7, 1.5, np.ones((4, 6), np.uint16)), Image(7, 1.5, np.ones((4, 6, 3), np.uint8))))
DESCRIPTION = encode(describe(MODES["640x480"]))


@given(st.sampled_from([FRAME, DESCRIPTION]), st.integers(0, 2**31), st.integers(1, 255), st.integers(0, 400))
@example(FRAME, 5, 255, 0)
@example(DESCRIPTION, 8, 255, 0)
def test_a_damaged_message_is_read_or_refused(message, place, change, cut):
    damaged = bytearray(message)
    damaged[place % len(damaged)] ^= change
    data = bytes(damaged[: len(damaged) - cut] if cut < len(damaged) else b"")
    try:
        read = read_message(io.BytesIO(data))
    except ConnectionLost:
        return
    # What was read can be sent again: sizes and types hold together.
    assert len(encode(read)) <= len(message) + 400


def test_a_length_beyond_all_frames_is_refused_before_memory_is_taken():
    with pytest.raises(ConnectionLost, match="no frames"):
        read_message(io.BytesIO(FRAME[:5] + b"\xff\xff\xff\xff"))
