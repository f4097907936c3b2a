"""Recordings of the twin's camera, and their way back through the driver."""

import numpy as np
import pytest

from robotcell.config import CameraMount, load_config
from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415, D415Options
from robotcell.errors import ConfigError, DeviceFault
from sim_twin.d415.renderer import MODES, SERIAL
from sim_twin.devices.backend import open_twin
from sim_twin.wire.d415.recorder import record
from tests.sim_twin.wire.d415.served_camera import WITHOUT_NOISE

FRAMES = 8
CONFIG = load_config(None, {**WITHOUT_NOISE, "backend.options.objects": 1})


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "scene.db3"
    record(CONFIG, path, FRAMES)
    return path


def player(path, resolution="640x480", **options):
    return D415(
        D415Options(source=str(path), warm_up_frames=3, **options), CameraMount(resolution=resolution), WallClock()
    )


def test_what_was_recorded_is_played_again_and_again(recording):
    with open_twin(CONFIG)[0] as cell:
        seen = cell.camera.read()
    with player(recording) as camera:
        called = camera._clock.now()
        frames = [camera.read() for _ in range(3 * FRAMES)]
    assert frames[0].t >= called
    assert frames[0].intrinsics.fx == pytest.approx(MODES["640x480"].fx)
    assert frames[0].serial == SERIAL
    # Longer than the recording is, and still each frame is a new one.
    assert (np.diff([frame.number for frame in frames]) >= 1).all()
    assert (np.diff([frame.t for frame in frames]) > 0).all()
    for frame in frames:
        np.testing.assert_array_equal(frame.color, seen.color)
        np.testing.assert_allclose(frame.depth_m, seen.depth_m, atol=0.00051)


def test_a_recording_of_another_camera_or_mode_is_refused(recording):
    with player(recording, serial=SERIAL) as camera:
        camera.read()
    with pytest.raises(DeviceFault, match=f"{SERIAL}.*424242"):
        player(recording, serial="424242").connect()
    with pytest.raises(DeviceFault, match=r"camera\.resolution"):
        player(recording, "1280x720").connect()


def test_a_recording_that_was_cut_off_is_called_so(recording, tmp_path):
    cut = tmp_path / "cut.db3"
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size * 9 // 10])
    with pytest.raises(ConfigError, match=r"no whole recording.*cut off.*record it again") as caught:
        player(cut).connect()
    assert "USB" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "words"), [("there.db3", "exists already"), ("scene.bag", r"\*\.db3"), ("nowhere/x.db3", "no such folder")]
)
def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path, name, words):
    (tmp_path / "there.db3").touch()
    with pytest.raises(ConfigError, match=words):
        record(CONFIG, tmp_path / name, FRAMES)
    assert [path.name for path in tmp_path.iterdir()] == ["there.db3"]


def test_a_scene_that_is_none_leaves_no_file(tmp_path):
    with pytest.raises(ConfigError, match="no such scene"):
        record(load_config(None, {"backend.options.scene": "no such scene"}), tmp_path / "x.db3", FRAMES)
    assert not list(tmp_path.iterdir())
