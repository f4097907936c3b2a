"""Records what the twin's camera sees of a scene, as a file that the SDK of the real camera plays."""

from __future__ import annotations

import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from robotcell.drivers.realsense import load_pyrealsense2, sdk_errors
from robotcell.errors import ConfigError
from sim_twin.backend import open_twin
from sim_twin.noise import DEPTH_UNIT_M
from sim_twin.renderer import FRAMES_PER_S, MODES
from sim_twin.wire.d415_device import SoftwareCamera
from sim_twin.wire.frames import Frame, Image, describe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from robotcell.config import CellConfig
    from robotcell.interfaces import RgbdFrame

# librealsense knows its recordings by it.
SUFFIX = ".db3"


def record(config: CellConfig, path: Path, frames: int, tell: Callable[[int], None] = lambda _: None) -> None:
    """Write a recording of a twin whose arm stands at home.

    Frames are written as they are rendered, at most 30 a second, and play at the pace at which they were written.

    Args:
        config: the cell; its backend must be the twin.
        path: of the file, which must not exist yet.
        frames: how many.
        tell: called with the number of frames so far.

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
    try:
        with open_twin(config)[0] as cell, sdk_errors(f"writing {path}"), _recording(path, camera):
            for count in range(1, frames + 1):
                due = time.monotonic() + 1 / FRAMES_PER_S
                camera.show(_as_streamed(cell.camera.read()))
                tell(count)
                time.sleep(max(0.0, due - time.monotonic()))
    except BaseException:
        path.unlink(missing_ok=True)
        raise


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
    now = time.time()
    depth = np.rint(frame.depth_m / np.float32(DEPTH_UNIT_M)).astype(np.uint16)
    return Frame(Image(frame.number, now, depth), Image(frame.number, now, frame.color))
