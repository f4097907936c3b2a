"""A served camera as librealsense sees it: a software device in the client's process, fed from the server's stream.

The entry point `twin` of the group `robotcell.camera_sources`.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.drivers.d415.realsense import load_pyrealsense2
from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.d415.noise import BASELINE_M
from sim_twin.wire.d415.stream import Description, Frame, InTime, Request, encode, read_message

if TYPE_CHECKING:
    from io import BufferedReader

    from sim_twin.wire.d415.stream import Image

_CONNECT_S = 2.0
_DEPTH_BYTES, _COLOR_BYTES = 2, 3


def open_source(address: str, resolution: str) -> StreamedCamera:
    """Connect to a served camera.

    Args:
        address: of the server, "host:port".
        resolution: of the frames, as "640x480".

    Raises:
        ConfigError: the address is none.
        ConnectionLost: no camera is served there.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"camera: twin://{address}: a host and a port are needed, as in twin://127.0.0.2:30415")
    try:
        connection = socket.create_connection((host, int(port)), _CONNECT_S)
    except OSError as error:
        raise ConnectionLost(
            f"camera: no camera is served at {address} ({error}); start one: robotcell twin serve"
        ) from error
    stream = connection.makefile("rb")
    try:
        connection.sendall(encode(Request(resolution=resolution)))
        # Past the buffer of the stream, which has no clock.
        description = read_message(InTime(connection, _CONNECT_S))
        if not isinstance(description, Description):
            raise ConnectionLost(f"camera: {address} does not say which camera it serves")
        connection.settimeout(None)
        return StreamedCamera(connection, stream, SoftwareCamera(description))
    except (OSError, ConnectionLost) as error:
        stream.close()
        connection.close()
        raise ConnectionLost(f"camera: {address} serves no camera: {error}") from error


class StreamedCamera:
    """A `CameraSource` with one camera, which shows what comes through a connection. When that ends, frames stop."""

    def __init__(self, connection: socket.socket, stream: BufferedReader, camera: SoftwareCamera) -> None:
        self._connection = connection
        self._stream = stream
        self._camera = camera
        self.context: Any = load_pyrealsense2().context()
        # librealsense forgets the device when this list goes.
        self._devices: list[Any] = []
        self.context.set_devices_changed_callback(lambda event: self._devices.append(event.get_new_devices()))
        camera.device.add_to(self.context)
        self._thread = threading.Thread(target=self._feed, name="served camera", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the connection. Idempotent."""
        with contextlib.suppress(OSError):  # the server was faster
            self._connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._stream.close()
        self._connection.close()
        self._devices.clear()
        self.context = None

    def _feed(self) -> None:
        # The driver notices that frames stay away.
        with contextlib.suppress(OSError, ConnectionLost):
            while isinstance(message := read_message(self._stream), Frame):
                self._camera.show(message)


class SoftwareCamera:
    """A software device that answers as a D415, with one mode, depth registered to colour.

    Args:
        description: of the camera.
    """

    def __init__(self, description: Description) -> None:
        rs = load_pyrealsense2()
        info = rs.camera_info
        self.description = description
        self.device = rs.software_device()
        for key, value in (
            (info.name, description.name),
            (info.serial_number, description.serial),
            (info.product_line, "D400"),
            (info.product_id, "0AD3"),
            (info.physical_port, "twin"),
            (info.firmware_version, description.firmware),
            (info.usb_type_descriptor, description.usb_type),
        ):
            self.device.register_info(key, value)
        self._depth = self.device.add_sensor("Stereo Module")
        # These make it a depth sensor, whose disparity can be had.
        self._depth.add_read_only_option(rs.option.depth_units, description.depth_unit_m)
        self._depth.add_read_only_option(rs.option.stereo_baseline, BASELINE_M * 1000)
        self._color = self.device.add_sensor("RGB Camera")
        self._depth_profile = self._depth.add_video_stream(
            self._mode(rs.stream.depth, 0, _DEPTH_BYTES, rs.format.z16), True
        )
        self._color_profile = self._color.add_video_stream(
            self._mode(rs.stream.color, 1, _COLOR_BYTES, rs.format.rgb8), True
        )
        same_place = rs.extrinsics()
        same_place.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        same_place.translation = [0, 0, 0]
        self._depth_profile.register_extrinsics_to(self._color_profile, same_place)

    def show(self, frame: Frame) -> None:
        """Let the device have taken a frame; one of another size than its mode is passed over."""
        self._show(self._depth, self._depth_profile, frame.depth, np.uint16)
        self._show(self._color, self._color_profile, frame.color, np.uint8)

    def _show(self, sensor: Any, profile: Any, image: Image, dtype: type[np.generic]) -> None:
        pixels = np.ascontiguousarray(image.pixels, dtype)
        # The library reads as much memory as its mode says.
        if pixels.shape[:2] != (self.description.height, self.description.width):
            return
        rs = load_pyrealsense2()
        shown = rs.software_video_frame()
        shown.pixels = pixels
        shown.bpp = pixels.nbytes // (pixels.shape[0] * pixels.shape[1])
        shown.stride = pixels.nbytes // pixels.shape[0]
        shown.timestamp = image.t * 1000
        shown.domain = rs.timestamp_domain.global_time
        shown.frame_number = image.number
        shown.profile = profile.as_video_stream_profile()
        sensor.on_video_frame(shown)

    def _mode(self, stream: Any, uid: int, bytes_per_pixel: int, pixel_format: Any) -> Any:
        rs = load_pyrealsense2()
        mode = rs.video_stream()
        mode.type, mode.index, mode.uid = stream, 0, uid
        mode.width, mode.height = self.description.width, self.description.height
        mode.fps, mode.bpp, mode.fmt = self.description.frames_per_s, bytes_per_pixel, pixel_format
        optics = rs.intrinsics()
        optics.width, optics.height = mode.width, mode.height
        optics.fx, optics.fy = self.description.fx, self.description.fy
        optics.ppx, optics.ppy = self.description.cx, self.description.cy
        # What a D415 says of its colour stream, with coefficients of zero.
        optics.model, optics.coeffs = rs.distortion.inverse_brown_conrady, [0.0] * 5
        mode.intrinsics = optics
        return mode
