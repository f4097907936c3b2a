"""A D415 in this process, of any geometry, that shows what a test draws."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.drivers.d415.realsense import load_pyrealsense2

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SERIAL = "123456789012"
PERIOD_S = 1 / 30


# Those that were made and have not ended.
_CAMERAS: list[FedCamera] = []


def open_source(_address: str, _resolution: str) -> FedCamera:
    """The entry point `fed` of `installed`: the newest camera."""
    return _CAMERAS[-1]


def install(folder: Path, module: str = __name__) -> None:
    """Make a folder of the path a distribution whose source of frames is `fed`, opened by `module`."""
    info = folder / "fed_camera-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fed-camera\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[robotcell.camera_sources]\nfed = {module}:open_source\n")


class FedCamera:
    """A `CameraSource`. A thread shows an image pair 30 times a second while `feeding` is set.

    Args:
        depth: (H, W) uint16 [mm], in the frame of the depth sensor; or a function of the frame number.
        color: (H, W, 3) uint8.
        baseline_m: how far the depth sensor is to the right of the colour sensor.
        focal_px: of both streams, (depth, colour).
        coeffs: distortion of the colour stream, Brown-Conrady.
        serial: of the device.
        domain: of the time stamps.
        reset: what a hardware reset does; None for a device that cannot be reset.
    """

    def __init__(
        self,
        depth: np.ndarray | Callable[[int], np.ndarray],
        color: np.ndarray,
        *,
        baseline_m: float = 0.0,
        focal_px: tuple[float, float] = (617.3, 617.3),
        coeffs: tuple[float, ...] = (0.0,) * 5,
        serial: str = SERIAL,
        domain: str = "global_time",
        reset: Callable[[], None] | None = None,
    ) -> None:
        self._rs = rs = load_pyrealsense2()
        self._pictures = depth, color
        self._domain = getattr(rs.timestamp_domain, domain)
        self.feeding = threading.Event()
        self.feeding.set()
        self._ended = threading.Event()
        self.device = rs.software_device()
        for key, value in (("name", "D415"), ("serial_number", serial), ("product_line", "D400")):
            self.device.register_info(getattr(rs.camera_info, key), value)
        self._depth, self._color = (self.device.add_sensor(name) for name in ("Stereo Module", "RGB Camera"))
        self._depth.add_read_only_option(rs.option.depth_units, 0.001)
        self._depth.add_read_only_option(rs.option.stereo_baseline, 55.0)
        height, width = color.shape[:2]
        self.color_optics = self._optics(width, height, focal_px[1], coeffs)
        depth_optics = self._optics(width, height, focal_px[0], (0.0,) * 5)
        self._depth_profile = self._stream(self._depth, rs.stream.depth, 1, 2, rs.format.z16, depth_optics)
        self._color_profile = self._stream(self._color, rs.stream.color, 2, 3, rs.format.rgb8, self.color_optics)
        place = rs.extrinsics()
        place.rotation, place.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [baseline_m, 0, 0]
        self._depth_profile.register_extrinsics_to(self._color_profile, place)
        self.context = rs.context() if reset is None else _resettable_context(rs, reset)
        self._devices: list[Any] = []
        self.context.set_devices_changed_callback(lambda event: self._devices.append(event.get_new_devices()))
        self.device.add_to(self.context)
        _CAMERAS.append(self)
        self._thread = threading.Thread(target=self._feed)
        self._thread.start()

    def close(self) -> None:
        """A driver closes its source; the test itself ends the device."""

    def end(self) -> None:
        """Stop showing anything."""
        if self in _CAMERAS:
            _CAMERAS.remove(self)
        self._ended.set()
        self._thread.join()
        self._devices.clear()

    def _feed(self) -> None:
        number = 0
        while not self._ended.wait(PERIOD_S):
            if self.feeding.is_set():
                number += 1
                depth, color = self._pictures
                self._show(self._depth, self._depth_profile, depth(number) if callable(depth) else depth, number)
                self._show(self._color, self._color_profile, color, number)

    def _show(self, sensor: Any, profile: Any, pixels: np.ndarray, number: int) -> None:
        frame = self._rs.software_video_frame()
        frame.pixels = np.ascontiguousarray(pixels)
        frame.stride = pixels.nbytes // len(pixels)
        frame.bpp = frame.stride // pixels.shape[1]
        frame.timestamp, frame.domain, frame.frame_number = time.time() * 1000, self._domain, number
        frame.profile = profile.as_video_stream_profile()
        sensor.on_video_frame(frame)

    def _optics(self, width: int, height: int, focal_px: float, coeffs: tuple[float, ...]) -> Any:
        optics = self._rs.intrinsics()
        optics.width, optics.height, optics.fx, optics.fy = width, height, focal_px, focal_px
        optics.ppx, optics.ppy = width / 2, height / 2
        optics.model, optics.coeffs = self._rs.distortion.brown_conrady, list(coeffs)
        return optics

    def _stream(self, sensor: Any, kind: Any, uid: int, size: int, pixel_format: Any, optics: Any) -> Any:
        stream = self._rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, 30
        stream.width, stream.height, stream.bpp, stream.fmt = optics.width, optics.height, size, pixel_format
        stream.intrinsics = optics
        return sensor.add_video_stream(stream, True)


def _resettable_context(rs: Any, reset: Callable[[], None]) -> Any:
    """A context whose devices are reset by a function: librealsense's software devices refuse to be."""

    class Device:
        def __init__(self, device: Any) -> None:
            self._device = device

        def __getattr__(self, name: str) -> Any:
            return getattr(self._device, name)

        def hardware_reset(self) -> None:
            reset()

    class Context(rs.context):  # type: ignore[misc]
        def query_devices(self) -> list[Device]:
            return [Device(device) for device in super().query_devices()]

    return Context()
