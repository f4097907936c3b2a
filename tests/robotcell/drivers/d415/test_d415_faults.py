"""The D415's driver and what looks through it, while a served camera fails in every way that it can."""

import json
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from robotcell.cell import Cell
from robotcell.config import CameraMount, load_config
from robotcell.config.calibration_file import CameraCalibration
from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415, D415Options
from robotcell.errors import CalibrationError, CellError, ConnectionLost, DeviceFault
from robotcell.interfaces import Devices
from sim_twin.d415.renderer import SERIAL
from sim_twin.wire.d415.server import CAMERA_FAULTS, WRONG_SERIAL
from sim_twin.wire.faults import Kind
from tests.addresses import loopback
from tests.robotcell.config.test_calibration_file import values
from tests.sim_twin.wire.d415.served_camera import WITHOUT_NOISE, ServedCamera

OFF, STUCK, SLOW, DELAYED, INTERMITTENT = Kind.OFF, Kind.STUCK, Kind.SLOW, Kind.DELAYED, Kind.INTERMITTENT
WRONG, GARBAGE = Kind.WRONG, Kind.GARBAGE
NO_FRAME, NO_DEPTH = "no frame came within 1 s", "nothing in the image has depth"
ONLY_ANOTHER = f"{SERIAL} is not connected, only {WRONG_SERIAL}"
# Each fault, and the error and words that it comes to: for a look at the table while the stream runs, and for
# connecting while it lasts. A camera of wrong depth can be connected to; a slow stream needs two seconds for three
# frames, which is neither an error nor worth waiting for.
FAULTS = [
    ("stream", OFF, "", None, ConnectionLost, NO_FRAME, ConnectionLost, "robotcell twin serve"),
    ("stream", STUCK, "", None, DeviceFault, "frozen", DeviceFault, "frozen"),
    ("stream", SLOW, "", 0.02, ConnectionLost, NO_FRAME, None, ""),
    ("stream", DELAYED, "", 1.5, (DeviceFault, ConnectionLost), "old|no frame came", DeviceFault, "old"),
    ("stream", INTERMITTENT, "", 60.0, ConnectionLost, NO_FRAME, ConnectionLost, "robotcell twin serve"),
    ("stream", WRONG, "serial", None, ConnectionLost, NO_FRAME, ConnectionLost, ONLY_ANOTHER),
    ("stream", WRONG, "resolution", None, ConnectionLost, NO_FRAME, DeviceFault, r"camera\.resolution"),
    ("stream", WRONG, "usb2", None, ConnectionLost, NO_FRAME, DeviceFault, r"USB 2\.1"),
    ("depth", GARBAGE, "", None, DeviceFault, NO_DEPTH, DeviceFault, NO_DEPTH),
    ("depth", WRONG, "scale", 10.0, DeviceFault, "sees 0% of the workspace", None, ""),
    ("depth", WRONG, "tilt", 0.05, CalibrationError, "tilted", None, ""),
    ("depth", WRONG, "holes", 0.9, DeviceFault, "of the workspace", None, ""),
    ("color", GARBAGE, "", None, DeviceFault, "black", DeviceFault, "black"),
    ("color", DELAYED, "", 0.5, DeviceFault, "apart", DeviceFault, "apart"),
]
LIMIT_S = 20.0
# A second is what the driver waits for; the machine may be busy.
SOON_S = 10.0


@pytest.fixture(scope="module")
def served():
    with ServedCamera(loopback(36), overrides=WITHOUT_NOISE) as camera:
        yield camera


@pytest.fixture(autouse=True)
def lift(served):
    yield
    served.inject()


def driver(served, serial=SERIAL, **mount):
    """The exposure of this camera has nothing to settle."""
    options = D415Options(source=served.source, serial=serial, warm_up_frames=3)
    return D415(options, CameraMount(**mount), WallClock())


def soon(do):
    """As soon as the camera is back. On a busy machine its first frames may come late, too."""
    end = time.monotonic() + LIMIT_S
    while True:
        try:
            return do()
        except CellError:
            if time.monotonic() > end:
                raise
        time.sleep(0.05)


def again_and_again(do):
    """Until it fails, which each time takes no longer than the driver waits for."""
    end = time.monotonic() + LIMIT_S
    while (begun := time.monotonic()) < end:
        try:
            do()
        except CellError:
            assert time.monotonic() - begun < SOON_S
            raise


def looking(camera):
    """A cell whose arm stands at home and whose camera this is."""
    config = load_config()
    arm = SimpleNamespace(state=lambda: SimpleNamespace(q=np.array(config.motion.home_q), T_base_tcp=np.eye(4)))
    return Cell(config, Devices(arm, SimpleNamespace(), camera, WallClock()))


@contextmanager
def failing(fault, error, words):
    """As `pytest.raises`, which does not say of which fault it tells."""
    try:
        with pytest.raises(error, match=words):
            yield
    except (Exception, pytest.fail.Exception) as wrong:
        raise AssertionError(f"with the fault {fault}: {wrong}") from wrong


def test_every_fault_that_the_camera_declares_is_tried():
    assert {tuple(row[:3]) for row in FAULTS} == CAMERA_FAULTS


def test_a_fault_is_an_error_while_the_stream_runs_and_while_connecting_and_passes(served):
    # One fault after another: each meets the connection that was made again after the one before.
    with driver(served) as camera:
        cell = looking(camera)
        soon(cell.look)
        for *fault, error, words, error_connecting, words_connecting in FAULTS:
            served.inject(tuple(fault))
            with failing(fault, error, words):
                again_and_again(cell.look)
            if error_connecting is not None:
                with failing(fault, error_connecting, words_connecting):
                    again_and_again(lambda: camera.close() or camera.connect())
            camera.close()
            served.inject()
            soon(camera.connect)
            soon(cell.look)


@pytest.mark.parametrize(
    "fault",
    [("stream", SLOW, "", 0.3), ("stream", DELAYED, "", 0.2), ("depth", WRONG, "holes", 0.2)],
    ids=["slow", "late", "holes"],
)
def test_what_can_be_lived_with_is(served, fault):
    with driver(served) as camera:
        served.inject(fault)
        time.sleep(0.2)
        cell = looking(camera)
        views = [cell.look() for _ in range(3)]
    assert (np.diff([view.frame.number for view in views]) > 0).all()


def test_a_server_that_dies_is_lost_and_its_successor_is_found():
    with ServedCamera(loopback(37), overrides=WITHOUT_NOISE) as mortal, driver(mortal) as camera:
        camera.read()
        mortal.process.kill()
        with pytest.raises(ConnectionLost, match="no frame came"):
            again_and_again(camera.read)
        camera.close()
        with pytest.raises(ConnectionLost, match="robotcell twin serve"):
            camera.connect()
        mortal.end()
        assert "camera" in mortal.start()
        soon(camera.connect)
        soon(camera.read)


def calibration(tmp_path, **camera):
    path = tmp_path / "camera.json"
    optics = {"width": 640, "height": 480, "fx": 617, "fy": 617, "cx": 320, "cy": 240, "serial": SERIAL, **camera}
    path.write_text(json.dumps(values(camera=optics, date="2026-11-01T12:00:00Z")))
    assert CameraCalibration.model_validate_json(path.read_text())
    return path


def test_the_calibration_must_be_of_this_camera(served, tmp_path):
    with driver(served, calibration=calibration(tmp_path)) as camera:
        camera.read()
    for change, words in (({"serial": "424242"}, f"424242, and {SERIAL}"), ({"width": 1280}, "1280x480, and 640x480")):
        with pytest.raises(CalibrationError, match=words) as refusal:
            driver(served, calibration=calibration(tmp_path, **change)).connect()
        assert refusal.value.device == "camera"
