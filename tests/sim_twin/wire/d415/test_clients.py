"""The server's side of one connection, over a connection."""

import contextlib
import socket
import time

import pytest

from sim_twin.wire.d415.clients import Client
from sim_twin.wire.d415.stream import Request, encode

LIMIT_S = 10.0


@pytest.fixture
def pair():
    with socket.create_server(("127.0.0.35", 0)) as listener, socket.create_connection(listener.getsockname()) as far:
        near, _ = listener.accept()
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        yield near, far


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
    for byte in encode(Request(resolution="640x480")) if pause_s else b"":
        if client.gone:
            break
        with contextlib.suppress(ConnectionError):
            far.send(bytes([byte]))
        time.sleep(pause_s)
    until(lambda: client.gone)
    assert client.request is None
    client.close()


def test_a_client_that_does_not_read_its_frames_is_given_up(pair):
    near, far = pair
    client = Client(near, request_s=LIMIT_S, frame_s=0.1)
    far.sendall(encode(Request(resolution="640x480")))
    until(lambda: client.request is not None)
    client.offer(b"x" * 20_000_000)
    until(lambda: client.gone)
    client.close()
