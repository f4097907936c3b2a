"""Records what the twin's camera sees of a scene, as a file that the SDK of the real camera plays."""

from __future__ import annotations

import tempfile
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotcell.drivers.d415.realsense import load_pyrealsense2, sdk_errors
from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.d415.noise import DEPTH_UNIT_M
from sim_twin.d415.renderer import FRAMES_PER_S, MODES
from sim_twin.devices.backend import open_twin
from sim_twin.wire.d415.software_device import SoftwareCamera
from sim_twin.wire.d415.stream import Frame, Image, describe, encode, read_message

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from io import BufferedRandom
    from pathlib import Path

    from robotcell.config import CellConfig
    from robotcell.interfaces import RgbdFrame

# librealsense knows its recordings by it.
SUFFIX = ".db3"


def frames_in(seconds: float) -> int:
    """How many frames a recording of so many seconds has; at least one."""
    return max(1, round(seconds * FRAMES_PER_S))


def record(config: CellConfig, path: Path, frames: int, tell: Callable[[int], None] = lambda _: None) -> None:
    """Write a recording of a twin whose arm stands at home.

    All frames are rendered first, and then written at the pace at which they are to be played, 30 a second.

    Args:
        config: the cell; its backend must be the twin.
        path: of the file, which must not exist yet.
        frames: how many.
        tell: called with the number of frames rendered so far.

    Raises:
        ConfigError: the file cannot be written there, or the scene cannot be built.
        ConnectionLost: librealsense failed.
    """
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path}: a recording must be called *{SUFFIX}; librealsense takes no other name")
    if path.exists():
        raise ConfigError(f"{path} exists already; choose another name, or delete it")
    if not path.parent.is_dir():
        raise ConfigError(f"{path.parent}: no such folder")
    camera = SoftwareCamera(describe(MODES[config.camera.resolution]))
    with tempfile.TemporaryFile() as rendered:
        with open_twin(config)[0] as cell:
            for count in range(1, frames + 1):
                rendered.write(encode(_as_streamed(cell.camera.read())))
                tell(count)
        rendered.seek(0)
        try:
            with sdk_errors(f"writing {path}"), _recording(path, camera):
                _show(rendered, camera)
        except BaseException:
            path.unlink(missing_ok=True)
            raise


def _show(rendered: BufferedRandom, camera: SoftwareCamera) -> None:
    """Show all frames, 30 a second: at this pace they are played."""
    due = time.monotonic()
    with suppress(ConnectionLost):  # the end of the file
        while isinstance(frame := read_message(rendered), Frame):
            time.sleep(max(0.0, due - time.monotonic()))
            due += 1 / FRAMES_PER_S
            now = time.time()
            camera.show(Frame(replace(frame.depth, t=now), replace(frame.color, t=now)))


@contextmanager
def _recording(path: Path, camera: SoftwareCamera) -> Iterator[None]:
    """What the camera shows is written."""
    recorder = load_pyrealsense2().recorder(str(path), camera.device)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(lambda _frame: None)
    try:
        yield
    finally:
        for sensor in sensors:
            sensor.stop()
            sensor.close()
        # The file is complete when the recorder is gone.
        del sensor, sensors, recorder


def _as_streamed(frame: RgbdFrame) -> Frame:
    depth = np.rint(frame.depth_m / np.float32(DEPTH_UNIT_M)).astype(np.uint16)
    return Frame(Image(frame.number, frame.t, depth), Image(frame.number, frame.t, frame.color))
