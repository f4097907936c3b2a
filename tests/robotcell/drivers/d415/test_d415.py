"""The D415's driver over librealsense's own pipeline, fed by a device in this process."""

import gc
import time
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from robotcell.config import CameraMount
from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415, D415Options
from robotcell.drivers.d415.realsense import load_pyrealsense2
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault
from tests.robotcell.drivers.d415.fed_camera import SERIAL, FedCamera, install

GREY = np.full((480, 640, 3), 90, np.uint8)
WALL = np.full((480, 640), 900, np.uint16)
FOCAL_PX = 617.3


@pytest.fixture
def fed(monkeypatch, tmp_path):
    """Makes devices; the driver finds the newest one as fed://."""
    install(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    devices = []

    def make(depth=WALL, color=GREY, **options):
        devices.append(FedCamera(depth, color, **options))
        return devices[-1]

    yield make
    for device in devices:
        device.end()


def camera(resolution="640x480", **options):
    # The exposure of these cameras has nothing to settle.
    options = {"source": "fed://here", "warm_up_frames": 3, **options}
    return D415(D415Options(**options), CameraMount(resolution=resolution), WallClock())


def box_before_wall(optics, offset_m):
    """Depth [mm] as seen `offset_m` right of the colour sensor: a box of 0.2 m at 0.7 m before a wall at 0.9 m."""
    x = (np.arange(640) - optics.ppx) / optics.fx
    y = (np.arange(480) - optics.ppy) / optics.fy
    on_box = (abs(x * 0.7 + offset_m) < 0.1)[None] & (abs(y * 0.7) < 0.1)[:, None]
    return np.where(on_box, 700, 900).astype(np.uint16)


def test_depth_comes_out_registered_to_colour(fed):
    optics = SimpleNamespace(fx=580.0, fy=580.0, ppx=320.0, ppy=240.0)
    device = fed(box_before_wall(optics, 0.015), baseline_m=0.015, focal_px=(580.0, FOCAL_PX))
    with camera() as driver:
        frame = driver.read()
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (pytest.approx(FOCAL_PX), 320.0)
    expected = box_before_wall(device.color_optics, 0.0) == 700
    seen = abs(frame.depth_m - 0.7) < 0.001
    # The SDK puts each depth pixel to the nearest of colour, so edges are off by one at most.
    rows, columns = np.nonzero(seen)
    right_rows, right_columns = np.nonzero(expected)
    for found, right in ((rows, right_rows), (columns, right_columns)):
        assert abs(int(found.min()) - int(right.min())) <= 1
        assert abs(int(found.max()) - int(right.max())) <= 1
    assert (seen & expected).sum() > 0.95 * expected.sum()


def test_the_picture_is_undistorted(fed):
    rs = load_pyrealsense2()
    coeffs = (0.5, -0.2, 0.002, -0.001, 0.05)
    device = fed(coeffs=coeffs)
    device.end()
    rays = np.array([[rs.rs2_deproject_pixel_to_point(device.color_optics, [u, v], 1.0) for u in range(640)]
                     for v in range(480)])  # fmt: skip
    square = (abs(rays[..., :2]) < 0.25).all(axis=2)
    color = np.where(square[..., None], np.uint8(200), GREY)
    # The depth sensor itself has no distortion.
    x, y = (np.arange(640) - 320) / FOCAL_PX, (np.arange(480) - 240)[:, None] / FOCAL_PX
    fed(np.where((abs(x) < 0.25) & (abs(y) < 0.25), 700, 900).astype(np.uint16), color, coeffs=coeffs)
    with camera() as driver:
        frame = driver.read()
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (pytest.approx(FOCAL_PX), 320.0)
    inside = (abs(x) < 0.246) & (abs(y) < 0.246)
    outside = ((abs(x) > 0.254) | (abs(y) > 0.254)) & (abs(x) < 0.4) & (abs(y) < 0.3)
    assert (frame.color[inside] == 200).all()
    assert (frame.color[outside] == 90).all()
    assert (abs(frame.depth_m[inside] - 0.7) < 0.001).mean() > 0.9
    assert not (abs(frame.depth_m[outside] - 0.7) < 0.001).any()
    # The edges of the square were bent.
    assert (square & outside).sum() + (~square & inside).sum() > 500


@pytest.mark.parametrize(
    "options", [{"spatial_filter": True}, {"temporal_frames": 8}, {"spatial_filter": True, "temporal_frames": 3}]
)
def test_filters_smooth_and_invent_nothing(fed, options):
    rng = np.random.default_rng(1)
    noisy = [rng.normal(900, 4, WALL.shape).astype(np.uint16) for _ in range(7)]
    for image in noisy:
        image[100:200, 100:200] = 0
    fed(lambda number: noisy[number % 7])
    with camera() as plain:
        rough = plain.read().depth_m
    with camera(**options) as driver:
        called = time.monotonic()
        frame = driver.read()
    assert frame.t >= called
    assert (frame.depth_m[100:200, 100:200] == 0).all()
    assert (frame.depth_m > 0).sum() <= (rough > 0).sum()
    assert frame.depth_m[250:].std() < 0.7 * rough[250:].std()
    assert frame.depth_m[250:].mean() == pytest.approx(0.9, abs=0.002)


@pytest.mark.parametrize("domain", ["global_time", "system_time", "hardware_clock"])
def test_a_frame_was_taken_after_it_was_asked_for(fed, domain):
    numbers = iter(range(1000))
    taken = {}

    def depth(_number):
        shown = next(numbers)
        taken[600 + shown] = time.monotonic()
        return np.full_like(WALL, 600 + shown)

    fed(depth, domain=domain)
    with camera() as driver:
        for _ in range(5):
            time.sleep(0.08)
            called = time.monotonic()
            frame = driver.read()
            assert taken[round(float(frame.depth_m[0, 0]) * 1000)] >= called
            assert called <= frame.t <= time.monotonic()


def test_frames_of_no_use_are_given_back_at_once(fed):
    """Librealsense has some 16 frames; where they are all held, the stream stands still."""
    # The age of these frames is not known, so that the first after each call may be older than it.
    fed(domain="hardware_clock")
    gc.disable()
    try:
        with camera() as driver:
            numbers = [driver.read().number for _ in range(40)]
    finally:
        gc.enable()
    assert numbers[-1] >= 80


def test_the_second_user_is_told_that_the_camera_is_in_use(fed):
    fed()
    with camera(), pytest.raises(DeviceFault, match="another program"):
        camera().connect()


def test_a_mode_that_the_camera_has_not_is_named(fed):
    fed()
    with pytest.raises(DeviceFault, match=r"camera\.resolution"):
        camera("1280x720").connect()


def test_the_serial_number_decides(fed):
    fed()
    with camera(serial=SERIAL) as driver:
        driver.read()
    with pytest.raises(ConnectionLost, match=rf"424242.*{SERIAL}"):
        camera(serial="424242").connect()


def test_several_cameras_need_a_serial_number(fed):
    one, other = fed(), fed(serial="424242")
    one.device.add_to(other.context)
    with pytest.raises(DeviceFault, match=f"{SERIAL}, 424242"):
        camera().connect()


def test_a_dead_camera_is_given_up_after_three_tries(fed):
    device = fed()
    device.feeding.clear()
    driver = camera(first_frame_timeout_s=0.1)
    with pytest.raises(ConnectionLost, match=r"USB.*three times") as lost:
        driver.connect()
    assert lost.value.device == "camera"
    with pytest.raises(ConnectionLost, match="not connected"):
        driver.read()
    device.feeding.set()
    with driver:
        driver.read()


class Hurried(WallClock):
    """A wall clock on which nothing is waited for."""

    def sleep(self, dt):
        super().sleep(min(dt, 0.1))


def test_a_hardware_reset_comes_last_and_may_help(fed):
    resets = []

    def reset():
        resets.append(time.monotonic())
        device.feeding.set()

    device = fed(reset=reset)
    device.feeding.clear()
    wait_s = 0.3
    driver = D415(
        D415Options(source="fed://here", warm_up_frames=3, first_frame_timeout_s=wait_s),
        CameraMount(resolution="640x480"),
        Hurried(),
    )
    begin = time.monotonic()
    with driver:
        driver.read()
    # Two tries have waited for a frame before it, and the third one needed no second reset.
    assert len(resets) == 1
    assert resets[0] - begin >= 2 * wait_s


def test_closing_is_safe_at_any_time(fed):
    fed()
    driver = camera()
    driver.close()
    with driver as entered:
        assert entered is driver
        driver.connect()
        driver.read()
        driver.close()
        driver.close()
        with pytest.raises(ConnectionLost, match="not connected"):
            driver.read()
        driver.connect()
        driver.read()


def test_a_source_that_is_not_installed_is_named_among_those_that_are():
    with pytest.raises(ConfigError, match=r"'nobody'.*twin"):
        camera(source="nobody://127.0.0.35:1").connect()


def test_a_source_that_cannot_be_imported_says_so(monkeypatch, tmp_path):
    install(tmp_path, "no_such_module")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="No module named 'no_such_module'"):
        camera().connect()


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.35", "127.0.0.35:", "127.0.0.35:x", "127.0.0.35:99999", ":5"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(ConfigError, match=r"twin://127\.0\.0\.2:30415"):
        camera(source=f"twin://{address}").connect()


def test_nothing_at_the_address_is_lost():
    with pytest.raises(ConnectionLost, match=r"127\.0\.0\.35:9.*robotcell twin serve") as lost:
        camera(source="twin://127.0.0.35:9").connect()
    assert lost.value.device == "camera"


def test_no_such_camera_on_usb():
    with pytest.raises(ConnectionLost, match="connected"):
        camera(source="usb", serial="no such camera").connect()


def test_a_recording_that_is_not_there_or_none(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        camera(source=str(tmp_path / "x.db3")).connect()
    (tmp_path / "y.db3").write_bytes(b"this is no recording" * 100)
    with pytest.raises(ConfigError, match=r"y\.db3 is no whole recording"):
        camera(source=str(tmp_path / "y.db3")).connect()


@pytest.mark.parametrize(
    "options", [{"source": "USB"}, {"source": "scene.bag"}, {"source": ""}, {"temporal_frames": 9}, {"tempo": 1}]
)
def test_options_that_mean_nothing_are_refused(options):
    with pytest.raises(ValidationError):
        D415Options(**options)


def test_without_the_library_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    with pytest.raises(ConfigError, match=r"robotcell\[hardware\]"):
        load_pyrealsense2.__wrapped__()
