"""The server's side of one connection, over a connection."""

import contextlib
import socket
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_twin.wire.d415.clients import Client
from sim_twin.wire.d415.stream import Request, encode
from tests.addresses import loopback

LIMIT_S = 10.0


REQUEST = Request(resolution="640x480")


@contextlib.contextmanager
def connected():
    with socket.create_server((loopback(35), 0)) as listener, socket.create_connection(listener.getsockname()) as far:
        near, _ = listener.accept()
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        yield near, far


@pytest.fixture
def pair():
    with connected() as ends:
        yield ends


def until(condition):
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.mark.parametrize("pause_s", [None, 0.02])
def test_a_client_that_does_not_say_what_it_wants_is_given_up(pair, pause_s):
    near, far = pair
    client = Client(near, request_s=0.1, frame_s=LIMIT_S)
    assert not client.gone
    for byte in encode(REQUEST) if pause_s else b"":
        if client.gone:
            break
        with contextlib.suppress(ConnectionError):
            far.send(bytes([byte]))
        time.sleep(pause_s)
    until(lambda: client.gone)
    assert client.request is None
    client.close()


@settings(max_examples=20)
@given(st.one_of(st.binary(max_size=60), st.binary(max_size=60).map(lambda noise: encode(REQUEST)[:9] + noise)))
def test_noise_is_no_request(noise):
    with connected() as (near, far):
        client = Client(near, request_s=LIMIT_S, frame_s=LIMIT_S)
        far.sendall(noise)
        far.shutdown(socket.SHUT_WR)
        until(lambda: client.gone)
        assert client.request is None
        client.close()


def test_a_client_that_does_not_read_its_frames_is_given_up(pair):
    near, far = pair
    client = Client(near, request_s=LIMIT_S, frame_s=0.1)
    far.sendall(encode(REQUEST))
    until(lambda: client.request is not None)
    client.offer(b"x" * 20_000_000)
    until(lambda: client.gone)
    client.close()
