"""The doctor's look at the camera, and at the calibration of its mount."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415
from robotcell.drivers.doctor.timing import milliseconds
from robotcell.errors import ConfigError
from robotcell.findings import Finding, Grade

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.config import CameraMount
    from robotcell.drivers.d415.camera import D415Options

_MIN_FRAME_RATE = 25.0


def examine_camera(options: D415Options, mount: CameraMount, seconds: float) -> Iterator[Finding]:
    """Connect to the camera and time its frames for `seconds`.

    Raises:
        CellError: as `D415.connect` and `D415.read`.
    """
    clock = WallClock()
    with D415(options, mount, clock) as camera:
        yield Finding("camera", "device", camera.description)
        stamps: list[float] = []
        ages: list[float] = []
        numbers: list[int] = []
        end = time.monotonic() + seconds
        while not stamps or time.monotonic() < end:
            frame = camera.read()
            stamps.append(frame.t)
            ages.append(clock.now() - frame.t)
            numbers.append(frame.number)
    yield Finding("camera", "mode", f"{frame.intrinsics.width}x{frame.intrinsics.height}, fx {frame.intrinsics.fx:.1f}")
    share = float((frame.depth_m > 0).mean())
    yield Finding("camera", "depth", f"{share:.0%} of the pixels")
    rate = (numbers[-1] - numbers[0]) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else 0.0
    slow = rate < _MIN_FRAME_RATE
    yield Finding(
        "camera",
        "frames",
        f"{rate:.1f} per second, old by {milliseconds(ages)}",
        Grade.WRONG if slow else Grade.OK,
        "a USB 3 port of its own, and less load on this computer" if slow else "",
    )


def examine_calibration(mount: CameraMount) -> Iterator[Finding]:
    """What the calibration file of the camera says, and whether it fits.

    Raises:
        CalibrationError: it is of another resolution, or too old.
        ConfigError: it is not loaded.
    """
    if mount.calibration is None:
        yield Finding(
            "calibration",
            "file",
            "none",
            Grade.NOTE,
            "camera.calibration names none: the pose is what cell.toml says; calibrate for millimetres",
        )
        return
    measured = mount.measured
    if measured is None:
        raise ConfigError(f"{mount.calibration}: not loaded", device="camera")
    yield Finding(
        "calibration",
        "file",
        f"{mount.calibration}, {measured.date:%Y-%m-%d}, {measured.views} views, held out "
        f"{measured.held_out.mm.median:.1f} mm, camera {measured.camera.serial or 'not named'}",
    )
    measured.check(resolution=mount.size)
    yield Finding("calibration", "fits", f"{mount.resolution}, not too old")
