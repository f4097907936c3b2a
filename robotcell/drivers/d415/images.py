"""From librealsense's frames to undistorted colour and the depth registered to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.drivers.d415.realsense import load_pyrealsense2, sdk_errors
from robotcell.interfaces import Intrinsics

if TYPE_CHECKING:
    from collections.abc import Sequence

Maps = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]

# The SDK's defaults: weight of the newest frame, and the step in disparity (1/32 px) that is an edge.
_TEMPORAL_ALPHA = 0.4
_TEMPORAL_DELTA = 20.0


class D415Images:
    """Makes images of frames: filters on depth as measured, then alignment to colour, then undistortion.

    No step invents depth: holes stay holes.

    Args:
        profile: of the pipeline that was started.
        spatial_filter: smooth depth along its surfaces, edges kept.

    Raises:
        ConnectionLost: the device does not answer.
    """

    def __init__(self, profile: Any, spatial_filter: bool) -> None:
        self._rs = rs = load_pyrealsense2()
        with sdk_errors("asking the camera for its calibration"):
            depth = profile.get_stream(rs.stream.depth).as_video_stream_profile()
            color = profile.get_stream(rs.stream.color).as_video_stream_profile()
            self._depth_scale = np.float32(profile.get_device().first_depth_sensor().get_depth_scale())
            optics = color.get_intrinsics()
            registered = _same_view(depth, color)
        self.intrinsics = Intrinsics(optics.width, optics.height, optics.fx, optics.fy, optics.ppx, optics.ppy)
        self._maps = undistortion_maps(optics)
        # The SDK's alignment leaves holes where there is nothing to align.
        self._align = None if registered else rs.align(rs.stream.color)
        self._spatial = rs.spatial_filter() if spatial_filter else None

    def make(self, framesets: Sequence[Any]) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Colour (H, W, 3) RGB of the last frameset, and depth (H, W) [m] smoothed over all of them, 0 = no return.

        Raises:
            ConnectionLost: librealsense failed.
        """
        with sdk_errors("processing a frame"):
            frameset = self._filtered(framesets)
            if self._align is not None:
                frameset = self._align.process(frameset).as_frameset()
            color = np.array(frameset.get_color_frame().get_data(), np.uint8)
            depth = np.array(frameset.get_depth_frame().get_data(), np.uint16)
        if self._maps is not None:
            color = np.asarray(cv2.remap(color, *self._maps, cv2.INTER_LINEAR), np.uint8)
            # Between two depths there is nothing.
            depth = np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), np.uint16)
        return color, depth * self._depth_scale

    def _filtered(self, framesets: Sequence[Any]) -> Any:
        """The last frameset with its depth filtered, in disparity, where the noise is the same at all distances."""
        rs = self._rs
        if self._spatial is None and len(framesets) == 1:
            return framesets[0]
        to_disparity, to_depth = rs.disparity_transform(True), rs.disparity_transform(False)
        # Persistence fills holes from the past: off. A new one for each image: nothing of an earlier scene gets in.
        temporal = rs.temporal_filter(_TEMPORAL_ALPHA, _TEMPORAL_DELTA, 0) if len(framesets) > 1 else None
        filtered = framesets[-1]
        for frameset in framesets:
            filtered = to_disparity.process(frameset)
            for step in (self._spatial, temporal):
                filtered = filtered if step is None else step.process(filtered)
        return to_depth.process(filtered).as_frameset()


def undistortion_maps(optics: Any) -> Maps | None:
    """Where each pixel of the undistorted image comes from, as cv2.remap takes it; None without distortion.

    Args:
        optics: rs.intrinsics; the SDK's own projection is used, so that its distortion models mean what it means.
    """
    rs = load_pyrealsense2()
    if optics.model == rs.distortion.none or not any(optics.coeffs):
        return None
    x = (np.arange(optics.width) - optics.ppx) / optics.fx
    y = (np.arange(optics.height) - optics.ppy) / optics.fy
    pixels = np.array([[rs.rs2_project_point_to_pixel(optics, [u, v, 1.0]) for u in x] for v in y], np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


def _same_view(depth: Any, color: Any) -> bool:
    """Whether the pixels of both streams look along the same rays from the same point."""
    a, b = depth.get_intrinsics(), color.get_intrinsics()
    names = ("width", "height", "fx", "fy", "ppx", "ppy", "model", "coeffs")
    place = depth.get_extrinsics_to(color)
    return (
        all(getattr(a, name) == getattr(b, name) for name in names)
        and not any(place.translation)
        and list(place.rotation) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    )
