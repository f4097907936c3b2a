"""Driver of an Intel RealSense D415 over librealsense: on USB, from a recorded file, or from another source."""

from __future__ import annotations

import time
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

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
from robotcell.drivers.unconfirmed import warn_unconfirmed
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault
from robotcell.interfaces import Camera, RgbdFrame

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.config import CameraMount
    from robotcell.interfaces import Clock

FRAMES_PER_S = 30

# Frames in which automatic exposure settles.
_WARM_UP_FRAMES = 30
# A device takes up to a second from start to its first frame.
_FIRST_FRAME_S = 2.0
_FRAME_S = 1.0
# A device that was reset disappears within this time, and is back within the second.
_RESET_S = 3.0
_RETURN_S = 10.0
_POLL_S = 0.2
# Exposure, read-out and transfer of a frame: by how much it is older than its arrival, where the camera does not say.
_TRANSFER_S = 0.05
# Depth and colour of one moment; more than a period apart they are of two.
_SAME_MOMENT_S = 1 / FRAMES_PER_S
# Of pixels with depth, and mean count of 255: an image below is of a covered or broken camera, or of no light at all.
_MIN_DEPTH_SHARE = 0.01
_MIN_BRIGHTNESS = 5.0


class D415Options(BaseModel):
    """Options of the camera.

    Attributes:
        source: "usb"; the path of a recorded .db3 file; or NAME://ADDRESS, NAME being an entry point of the group
            `robotcell.camera_sources`.
        serial: of the camera; needed where several are connected.
        spatial_filter: librealsense's edge-preserving smoothing of depth.
        temporal_frames: how many frames a depth image is smoothed over, all taken after `read` was called.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: Annotated[str, Field(pattern=r"^(usb|.+\.db3|[a-z][a-z0-9_-]*://.+)$")] = "usb"
    serial: str | None = None
    spatial_filter: bool = False
    # They are held until the last has come; librealsense has 16 for everybody.
    temporal_frames: Annotated[int, Field(ge=1, le=8)] = 1


class CameraSource(Protocol):
    """Cameras that are not on USB. An entry point of the group `robotcell.camera_sources` is a function that opens one.

    It is called with the address and with the resolution that will be asked for, as "640x480", and raises
    ConnectionLost if nothing is there.
    """

    @property
    def context(self) -> Any:
        """The pyrealsense2 context in which the cameras are found."""
        ...

    def close(self) -> None:
        """End it. Called after the last stream has ended."""
        ...


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
        self._last_number = -1
        # Frames of earlier rounds of a recorded file.
        self._earlier_numbers = 0

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
        except BaseException:
            self.close()
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
            raise ConnectionLost("camera: it is not connected; call connect() first")
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
                t, number = self._check(frameset, called)
                framesets.append(frameset)
                if len(framesets) == self._options.temporal_frames:
                    color, depth_m = self._images.make(framesets)
                    framesets.clear()
                    _check_images(color, depth_m)
                    return RgbdFrame(t, number, color, depth_m, self._images.intrinsics, self._serial)
            except DeviceFault as fault:
                problem = str(fault)
        raise DeviceFault(problem) if problem else ConnectionLost(silence)

    def _connect(self) -> None:
        rs = load_pyrealsense2()
        width, height = self._mount.size
        config = rs.config()
        config.enable_stream(rs.stream.depth, 0, width, height, rs.format.z16, FRAMES_PER_S)
        config.enable_stream(rs.stream.color, 0, width, height, rs.format.rgb8, FRAMES_PER_S)
        if self._options.source == "usb" or "://" in self._options.source:
            context = self._open_source(rs)
            device = find_device(context, self._options.serial)
            check_usb(device)
            config.enable_device(serial_number(device))
        else:
            context = rs.context()
            device = self._open_recording(rs, context, config)
        self._serial = serial_number(device)
        self.description = describe_device(device)
        if self._mount.measured is not None:
            self._mount.measured.check(serial=self._serial, resolution=(width, height))
        self._start(rs, context, config, device)

    def _open_source(self, rs: Any) -> Any:
        """The context in which the camera is to be found."""
        if self._options.source == "usb":
            return rs.context()
        name, _, address = self._options.source.partition("://")
        installed = {entry.name: entry for entry in entry_points(group="robotcell.camera_sources")}
        if name not in installed:
            raise ConfigError(
                f"camera: no source of frames is called {name!r}; installed: {', '.join(sorted(installed)) or 'none'}"
            )
        try:
            open_source = installed[name].load()
        except ImportError as error:
            raise ConfigError(f"camera: the source {name!r} cannot be imported ({error}); install its extra") from error
        self._source = open_source(address, self._mount.resolution)
        return self._source.context

    def _open_recording(self, rs: Any, context: Any, config: Any) -> Any:
        """The device that a recorded file holds."""
        path = Path(self._options.source)
        if not path.is_file():
            raise ConfigError(f"camera: {path}: no such file; make one with robotcell twin record")
        with sdk_errors(f"opening {path}"):
            config.enable_device_from_file(str(path))
            device = config.resolve(rs.pipeline_wrapper(rs.pipeline(context))).get_device()
        if self._options.serial not in (None, serial_number(device)):
            raise DeviceFault(
                f"camera: {path} was recorded by {serial_number(device)}, and the option camera.serial asks for "
                f"{self._options.serial}"
            )
        return device

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
                    raise ConnectionLost(f"{error} (tried three times)") from error

    def _stream(self, rs: Any, context: Any, config: Any) -> None:
        """Start the streams, wait until exposure has settled, and see whether a frame can be used."""
        pipeline = rs.pipeline(context)
        with sdk_errors("starting the streams"):
            profile = pipeline.start(config)
        self._pipeline = pipeline
        for i in range(_WARM_UP_FRAMES):
            frameset = self._wait(_FRAME_S if i else _FIRST_FRAME_S)
            if frameset is None:
                raise ConnectionLost(f"camera: its streams are started, but no frame comes; {USB_ADVICE}")
            self._last_number = frameset.get_frame_number()
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
        self._last_number, self._earlier_numbers = -1, 0
        if pipeline is not None:
            with suppress(RuntimeError):  # the device is gone
                pipeline.stop()

    def _wait(self, seconds: float) -> Any:
        """The next frameset, None if none comes in time."""
        with sdk_errors("waiting for a frame"):
            came, frameset = self._pipeline.try_wait_for_frames(max(1, round(seconds * 1000)))
        return frameset if came else None

    def _check(self, frameset: Any, called: float) -> tuple[float, int]:
        """Time of capture on the cell's clock [s] and number of a frameset.

        Raises:
            DeviceFault: it is not to be used.
        """
        depth, color = frameset.get_depth_frame(), frameset.get_color_frame()
        if not depth or not color:
            raise DeviceFault(f"camera: frames come without {'colour' if depth else 'depth'}; {USB_ADVICE}")
        # Two streams that do not match come in turn, each with the last frame of the other.
        apart_s = abs(depth.get_timestamp() - color.get_timestamp()) / 1000
        if apart_s > _SAME_MOMENT_S:
            raise DeviceFault(
                f"camera: colour and depth are {apart_s:.2f} s apart: one of the streams lags or stands still; "
                "connect again"
            )
        number = depth.get_frame_number() + self._earlier_numbers
        if number <= self._last_number:
            if not self._recorded:
                raise DeviceFault(f"camera: it repeats frame {number}: its stream is frozen; plug it in again")
            # The recording has begun again.
            self._earlier_numbers += self._last_number + 1 - number
            number = self._last_number + 1
        self._last_number = number
        t = min(self._time_of(depth), self._time_of(color))
        if t < called:
            raise DeviceFault(
                f"camera: the newest frame is {self._clock.now() - t:.2f} s old: frames come late; is the machine, or "
                "the USB port, overloaded?"
            )
        return t, number

    def _time_of(self, frame: Any) -> float:
        """Time of capture on the cell's clock [s]; where the camera does not tell, not later than it can be."""
        rs, now = load_pyrealsense2(), self._clock.now()
        if self._recorded:
            return now
        domain = frame.get_frame_timestamp_domain()
        if domain == rs.timestamp_domain.hardware_clock:
            return now - _TRANSFER_S
        age_s = max(0.0, time.time() - float(frame.get_timestamp()) / 1000)
        return now - age_s - (0.0 if domain == rs.timestamp_domain.global_time else _TRANSFER_S)


def _check_images(color: npt.NDArray[np.uint8], depth_m: npt.NDArray[np.float32]) -> None:
    if np.count_nonzero(depth_m) < _MIN_DEPTH_SHARE * depth_m.size:
        raise DeviceFault(
            "camera: nothing in the image has depth; is a lens covered, or is something nearer than 0.3 m (0.45 m at "
            "1280x720)?"
        )
    if color[::8, ::8].mean() < _MIN_BRIGHTNESS:
        raise DeviceFault("camera: the colour image is black; is the lens covered, or the light off?")
