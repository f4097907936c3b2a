"""Driver of an Intel RealSense D415 over librealsense: on USB, from a recorded file, or from another source."""

from __future__ import annotations

import functools
import math
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from robotcell.drivers.d415.frame_check import FRAMES_PER_S, FrameCheck, check_images
from robotcell.drivers.d415.images import D415Images
from robotcell.drivers.d415.realsense import (
    USB_ADVICE,
    check_usb,
    describe_device,
    find_device,
    load_pyrealsense2,
    sdk_errors,
    serial_number,
)
from robotcell.drivers.d415.source import open_recording, open_source
from robotcell.drivers.unconfirmed import warn_unconfirmed
from robotcell.errors import CellError, ConnectionLost, DeviceFault
from robotcell.interfaces import Camera, RgbdFrame

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.config import CameraMount
    from robotcell.drivers.d415.source import CameraSource
    from robotcell.interfaces import Clock

_FRAME_S = 1.0
# A device that was reset disappears within this time, and is back within the second.
_RESET_S = 3.0
_RETURN_S = 10.0
_POLL_S = 0.2


class D415Options(BaseModel):
    """Options of the camera.

    Attributes:
        source: "usb"; the path of a recorded .db3 file; or NAME://ADDRESS, NAME being an entry point of the group
            `robotcell.camera_sources`.
        serial: of the camera; needed where several are connected.
        spatial_filter: librealsense's edge-preserving smoothing of depth.
        temporal_frames: how many frames a depth image is smoothed over, all taken after `read` was called.
        warm_up_frames: frames in which automatic exposure settles, which are not used.
        first_frame_timeout_s: within which a device must send its first frame; it takes up to a second.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: Annotated[str, Field(pattern=r"^(usb|.+\.db3|[a-z][a-z0-9_-]*://.+)$")] = "usb"
    serial: str | None = None
    spatial_filter: bool = False
    # They are held until the last has come; librealsense has 16 for everybody.
    temporal_frames: Annotated[int, Field(ge=1, le=8)] = 1
    warm_up_frames: Annotated[int, Field(ge=1, le=300)] = 30
    first_frame_timeout_s: Annotated[float, Field(ge=0.1, le=30.0)] = 2.0


class D415(Camera):
    """A D415, colour and depth at 30 frames a second.

    Frames come out as the twin's do: undistorted, depth registered to colour, holes left as holes.

    Args:
        options: see there.
        mount: resolution, and the calibration that must fit the camera.
        clock: of the cell.
    """

    def __init__(self, options: D415Options, mount: CameraMount, clock: Clock) -> None:
        self._options = options
        self._mount = mount
        self._clock = clock
        self._recorded = options.source.endswith(".db3")
        self._source: CameraSource | None = None
        self._pipeline: Any = None
        self._images: D415Images | None = None
        self._serial: str | None = None
        # What is connected, in words; empty before.
        self.description = ""
        self._frame_check = FrameCheck(clock, recorded=self._recorded)
        # Of the polls for one frame: since when, what has come of it, and what was wrong with the last frame.
        self._polled_since = math.nan
        self._polled: list[Any] = []
        self._poll_problem = ""

    def connect(self) -> None:
        """Start the streams and wait until exposure has settled. Tries three times, the last after a hardware reset.

        Raises:
            ConnectionLost: the camera is not there, or sends nothing.
            DeviceFault: it is on USB 2, in use, has no such mode, or delivers stale or unusable frames.
            CalibrationError: `camera.calibration` is of another camera, of another resolution, or too old.
            ConfigError: the source is not there, or pyrealsense2 is not installed.
        """
        if self._images is not None:
            return
        if self._options.source == "usb":
            warn_unconfirmed("D415")
        try:
            self._connect()
        except BaseException as error:
            self.close()
            if isinstance(error, CellError):
                # A source of frames and a calibration file know of no device.
                error.device = "camera"
            raise

    def close(self) -> None:
        """End the streams."""
        self._stop()
        source, self._source = self._source, None
        if source is not None:
            source.close()

    def read(self) -> RgbdFrame:
        """A frame that was taken after this call.

        Raises:
            ConnectionLost: no frame came within a second, or the camera is not connected.
            DeviceFault: for a second all frames were stale, repeated, dark, without depth, or had colour and depth of
                different moments.
        """
        if self._images is None:
            raise ConnectionLost("camera: it is not connected; call connect() first", device="camera")
        called = self._clock.now()
        with sdk_errors("emptying the queue of frames"):
            self._pipeline.poll_for_frames()
        deadline = called + _FRAME_S * self._options.temporal_frames
        # Kept as words: an error would keep the frames that it came from, of which librealsense has only a few.
        silence = f"camera: no frame came within {_FRAME_S:g} s; {USB_ADVICE}"
        problem = ""
        framesets: list[Any] = []
        while (left := deadline - self._clock.now()) > 0:
            frameset = self._wait(left)
            if frameset is None:
                # After a last frame that was of no use the stream has ended.
                problem = "" if left > _FRAME_S / 2 else problem
                break
            try:
                t, number = self._frame_check.check(frameset, called)
                framesets.append(frameset)
                if len(framesets) == self._options.temporal_frames:
                    return _develop(self._images, framesets, t, number, self._serial)
            except DeviceFault as fault:
                problem = str(fault)
        raise DeviceFault(problem, device="camera") if problem else ConnectionLost(silence, device="camera")

    def poll(self, since: float) -> Callable[[], RgbdFrame] | None:
        """A frame that was taken at `since` or later; see `Camera`.

        Raises:
            ConnectionLost: no frame has come for a second since then, or the camera is not connected.
            DeviceFault: for a second all frames were stale, repeated, or had colour and depth of different moments.
        """
        images, serial = self._images, self._serial
        if images is None:
            raise ConnectionLost("camera: it is not connected; call connect() first", device="camera")
        if since != self._polled_since:
            self._polled_since, self._polled, self._poll_problem = since, [], ""
        with sdk_errors("asking for a frame"):
            frameset = self._pipeline.poll_for_frames()
        if frameset.size():
            try:
                t, number = self._frame_check.check(frameset, since)
                self._polled.append(frameset)
                if len(self._polled) == self._options.temporal_frames:
                    framesets, self._polled = self._polled, []
                    return functools.partial(_develop, images, framesets, t, number, serial)
            except DeviceFault as fault:
                self._poll_problem = str(fault)
        if self._clock.now() - since > _FRAME_S * self._options.temporal_frames:
            if self._poll_problem:
                raise DeviceFault(self._poll_problem, device="camera")
            raise ConnectionLost(f"camera: no frame came within {_FRAME_S:g} s; {USB_ADVICE}", device="camera")
        return None

    def _connect(self) -> None:
        rs = load_pyrealsense2()
        width, height = self._mount.size
        config = rs.config()
        config.enable_stream(rs.stream.depth, 0, width, height, rs.format.z16, FRAMES_PER_S)
        config.enable_stream(rs.stream.color, 0, width, height, rs.format.rgb8, FRAMES_PER_S)
        if self._recorded:
            context = rs.context()
            device = open_recording(rs, context, config, Path(self._options.source), self._options.serial)
        else:
            if self._options.source == "usb":
                context = rs.context()
            else:
                self._source = open_source(self._options.source, self._mount.resolution)
                context = self._source.context
            device = find_device(context, self._options.serial)
            check_usb(device)
            config.enable_device(serial_number(device))
        self._serial = serial_number(device)
        self.description = describe_device(device)
        if self._mount.measured is not None:
            self._mount.measured.check(serial=self._serial, resolution=(width, height))
        self._start(rs, context, config, device)

    def _start(self, rs: Any, context: Any, config: Any, device: Any) -> None:
        for last_try in (False, False, True):
            if last_try:
                self._reset(context, device)
            try:
                self._stream(rs, context, config)
                return
            except ConnectionLost as error:
                self._stop()
                if last_try:
                    raise ConnectionLost(f"{error} (tried three times)", device="camera") from error

    def _stream(self, rs: Any, context: Any, config: Any) -> None:
        """Start the streams, wait until exposure has settled, and see whether a frame can be used."""
        pipeline = rs.pipeline(context)
        with sdk_errors("starting the streams"):
            profile = pipeline.start(config)
        self._pipeline = pipeline
        self._frame_check = FrameCheck(self._clock, recorded=self._recorded)
        for i in range(self._options.warm_up_frames):
            frameset = self._wait(_FRAME_S if i else self._options.first_frame_timeout_s)
            if frameset is None:
                raise ConnectionLost(
                    f"camera: its streams are started, but no frame comes; {USB_ADVICE}", device="camera"
                )
            self._frame_check.skip(frameset)
        self._images = D415Images(profile, self._options.spatial_filter)
        self.read()

    def _reset(self, context: Any, device: Any) -> None:
        try:
            device.hardware_reset()
        except RuntimeError:
            return  # no hardware
        self._clock.sleep(_RESET_S)
        deadline = self._clock.now() + _RETURN_S
        while True:
            try:
                find_device(context, self._serial)
                return
            except ConnectionLost:
                if self._clock.now() > deadline:
                    raise
            self._clock.sleep(_POLL_S)

    def _stop(self) -> None:
        pipeline, self._pipeline, self._images = self._pipeline, None, None
        if pipeline is not None:
            with suppress(RuntimeError):  # the device is gone
                pipeline.stop()

    def _wait(self, seconds: float) -> Any:
        """The next frameset, None if none comes in time."""
        with sdk_errors("waiting for a frame"):
            came, frameset = self._pipeline.try_wait_for_frames(max(1, round(seconds * 1000)))
        return frameset if came else None


def _develop(images: D415Images, framesets: list[Any], t: float, number: int, serial: str | None) -> RgbdFrame:
    """The frame of its raw framesets, which are let go.

    Raises:
        DeviceFault: its images are of no use.
    """
    color, depth_m = images.make(framesets)
    framesets.clear()
    check_images(color, depth_m)
    return RgbdFrame(t, number, color, depth_m, images.intrinsics, serial)
