"""The camera's process, as its supervisor and its clients meet it."""

import os
import signal
import socket
import time

import numpy as np
import psutil
import pytest

from robotcell.errors import ConnectionLost
from sim_twin.d415.renderer import MODES, Renderer
from sim_twin.options import NoiseOptions, TwinOptions
from sim_twin.wire.faults import Kind
from tests.addresses import loopback
from tests.sim_twin.wire.d415.served_camera import WITHOUT_NOISE, RawClient, ServedCamera

HOST = loopback(31)
LIMIT_S = 20.0


@pytest.fixture(scope="module")
def camera():
    with ServedCamera(HOST) as served:
        yield served


@pytest.fixture(scope="module")
def clean():
    """A camera without noise, which shows exactly what it is told."""
    with ServedCamera(loopback(32), overrides=WITHOUT_NOISE) as served:
        yield served


@pytest.fixture(autouse=True)
def lift_faults(request):
    yield
    for name in {"camera", "clean"} & set(request.fixturenames):
        request.getfixturevalue(name).inject()


def truth(served, resolution):
    mount = served.config.camera.model_copy(update={"resolution": resolution})
    noise = NoiseOptions(**served.config.backend.options["noise"])
    renderer = Renderer(served.visuals, mount, TwinOptions(noise=noise))
    hits = renderer.cast(served.poses)
    return hits.depth_m, renderer.color(hits)


@pytest.mark.parametrize("resolution", sorted(MODES))
def test_frames_show_what_stands_there(clean, resolution):
    with RawClient(clean, resolution) as client:
        frame = client.frame()
    depth_m, color = truth(clean, resolution)
    assert (client.description.width, client.description.height) == frame.depth.pixels.shape[::-1]
    np.testing.assert_allclose(frame.depth.pixels * client.description.depth_unit_m, depth_m, atol=0.00051)
    np.testing.assert_array_equal(frame.color.pixels, color)
    assert abs(time.time() - frame.depth.t) < LIMIT_S


def test_what_moves_is_seen_to_move(clean):
    with RawClient(clean) as client:
        before = client.depth_m()
        clean.move(1, (0.0, 0.0, 0.1))
        end = time.monotonic() + LIMIT_S
        while np.array_equal(client.depth_m(), before):
            assert time.monotonic() < end
        client.frame()
        np.testing.assert_allclose(client.depth_m(), truth(clean, "640x480")[0], atol=0.00051)


def test_each_frame_is_newer_and_has_noise_of_its_own(camera):
    with RawClient(camera) as client:
        frames = [client.frame() for _ in range(4)]
    assert (np.diff([frame.depth.number for frame in frames]) >= 1).all()
    assert (np.diff([frame.depth.t for frame in frames]) > 0).all()
    assert all(frame.depth.number == frame.color.number for frame in frames)
    assert (frames[0].depth.pixels != frames[3].depth.pixels).mean() > 0.3


def test_colour_is_dark_at_first_and_settles(camera):
    end = time.monotonic() + LIMIT_S
    first = last = 1.0
    # Until the server has missed the client before this one, its stream goes on.
    while first >= 0.5 * last:
        assert time.monotonic() < end
        time.sleep(0.2)
        with RawClient(camera) as client:
            first, *_, last = [client.frame().color.pixels.mean() for _ in range(25)]


def test_nothing_is_rendered_while_nobody_looks(camera):
    with RawClient(camera) as client:
        client.frame()
    process = psutil.Process(camera.process.pid)
    time.sleep(0.3)
    before = sum(process.cpu_times()[:2])
    time.sleep(1.0)
    assert sum(process.cpu_times()[:2]) - before < 0.15


def test_a_client_that_does_not_read_loses_whole_frames_and_holds_up_nobody(camera):
    with RawClient(camera) as slow, RawClient(camera) as quick:
        numbers = [quick.frame().depth.number for _ in range(30)]
        late = [slow.frame().depth.number for _ in range(8)]
    assert max(np.diff(numbers)) < 30
    assert max(np.diff(late)) > 5


def test_a_client_that_talks_nonsense_is_dropped(camera):
    with socket.create_connection((camera.host, camera.port)) as connection:
        connection.settimeout(LIMIT_S)
        connection.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert connection.recv(100) == b""
    with RawClient(camera) as client:
        client.frame()


def test_each_client_has_the_mode_that_it_asked_for(camera):
    with RawClient(camera, "640x480") as small, RawClient(camera, "1280x720") as large:
        assert small.frame().depth.pixels.shape == (480, 640)
        assert large.frame().depth.pixels.shape == (720, 1280)


def test_tilt_scale_and_holes_are_in_the_depth_that_is_sent(clean):
    right = truth(clean, "640x480")[0]
    optics = MODES["640x480"]
    lean = 1 + 0.1 * (np.arange(640) - optics.cx) / optics.fx
    for what, value, expected in (("tilt", 0.1, right * lean), ("scale", 2.0, right * 2)):
        clean.inject(("depth", Kind.WRONG, what, value))
        np.testing.assert_allclose(settled(clean), expected, atol=0.00051)
    clean.inject(("depth", Kind.WRONG, "holes", 0.4))
    assert (settled(clean)[right > 0] == 0).mean() == pytest.approx(0.4, abs=0.05)


def ends(client):
    """Whether the stream ends, after what is still on its way."""
    try:
        for _ in range(200):
            client.frame()
    except (ConnectionLost, ConnectionResetError):
        return True
    return False


def settled(served):
    """Depth after a fault has come into force."""
    with RawClient(served) as client:
        frames = [client.depth_m() for _ in range(4)]
    return frames[-1]


def test_off_closes_the_port_and_it_comes_back(camera):
    with RawClient(camera) as client:
        client.frame()
        camera.inject(("stream", Kind.OFF, "", None))
        assert ends(client)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((camera.host, camera.port))
    camera.inject()
    end = time.monotonic() + LIMIT_S
    while True:
        try:
            with RawClient(camera) as client:
                client.frame()
            break
        except ConnectionRefusedError:
            assert time.monotonic() < end
            time.sleep(0.05)


def test_a_port_that_is_taken_is_named():
    with socket.create_server((loopback(33), 0)) as taken:
        port = taken.getsockname()[1]
        second = ServedCamera(loopback(33), port)
        with pytest.raises(AssertionError, match=f"port {port} of {loopback(33)}"), second:
            pass
        second.end()


@pytest.mark.parametrize("how", ["supervisor", "SIGTERM"])
def test_it_ends_with_its_supervisor_and_on_sigterm(how):
    with ServedCamera(loopback(34)) as served, RawClient(served) as client:
        client.frame()
        os.kill(served.process.pid, signal.SIGINT)
        client.frame()
        if how == "SIGTERM":
            os.kill(served.process.pid, signal.SIGTERM)
            served.process.join(LIMIT_S)
        assert served.end() == 0
        assert ends(client)
