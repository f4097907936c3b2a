"""The images that the served camera sends: the world at one instant, and the faults of the images themselves."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sim_twin.d415.noise import DEPTH_UNIT_M
from sim_twin.d415.renderer import FRAMES_PER_S
from sim_twin.wire.d415.stream import Frame, Image
from sim_twin.wire.faults import Kind

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Intrinsics
    from sim_twin.d415.renderer import Bytes, Floats, Renderer
    from sim_twin.wire.faults import FaultInbox

Depths = npt.NDArray[np.uint16]

IMAGE_FAULTS: frozenset[tuple[str, Kind, str]] = frozenset(
    {
        ("depth", Kind.GARBAGE, ""),  # nothing has depth
        ("depth", Kind.WRONG, "scale"),  # `value` times too large, 10 unless given
        ("depth", Kind.WRONG, "tilt"),  # planes lean by `value` rad to one side, 0.05 unless given
        ("depth", Kind.WRONG, "holes"),  # blobs of this share have no depth, 0.5 unless given
        ("color", Kind.GARBAGE, ""),  # dark
        ("color", Kind.DELAYED, ""),  # `value` seconds older than the depth, 0.5 unless given; at most 5
    }
)

# Nothing has moved that has not moved by this much [m, rad]: a tenth of the depth noise, and of a pixel. Objects at
# rest tremble by a third of it.
_SAME_POSE = 1e-4
_HOLE_PX = 16
_LONGEST_DELAY_S = 5.0
_DARK = 64


class ImageMaker:
    """Makes the frames of one mode. Rays are cast again only when something has moved; the noise is always fresh."""

    def __init__(self, renderer: Renderer, faults: FaultInbox) -> None:
        self._renderer = renderer
        self._faults = faults
        self._poses: Array | None = None
        self._depth_m: Floats = np.zeros((0, 0), np.float32)
        self._incidence_cos: Floats = np.zeros((0, 0), np.float32)
        self._color: Bytes = np.zeros((0, 0, 3), np.uint8)
        self._past_colors: deque[Image] = deque(maxlen=round(_LONGEST_DELAY_S * FRAMES_PER_S))

    @property
    def intrinsics(self) -> Intrinsics:
        """Of both images."""
        return self._renderer.intrinsics

    def make(self, poses: Array, t: float, number: int, frames_since_start: int) -> Frame:
        """One frame.

        Args:
            poses: (K, 4, 4) of all visuals.
            t: time of capture, seconds since the epoch.
            number: of the frame.
            frames_since_start: which automatic exposure follows.
        """
        self._look(poses)
        depth_m = self._renderer.measured_depth(self._depth_m, self._incidence_cos, number)
        color = self._renderer.measured_color(self._color, number, t, frames_since_start)
        return Frame(Image(number, t, self._spoil_depth(depth_m, number)), self._spoil_color(Image(number, t, color)))

    def _look(self, poses: Array) -> None:
        if self._poses is not None and float(np.abs(poses - self._poses).max(initial=0.0)) < _SAME_POSE:
            return
        hits = self._renderer.cast(poses)
        self._depth_m = hits.depth_m
        self._incidence_cos = self._renderer.incidence_cos(hits)
        self._color = self._renderer.color(hits)
        self._poses = poses.copy()

    def _spoil_depth(self, depth_m: Floats, number: int) -> Depths:
        value = self._value("depth", Kind.WRONG, "tilt", 0.05)
        if value is not None:
            columns = np.arange(depth_m.shape[1], dtype=np.float32)
            depth_m = depth_m * (1 + np.float32(value) * (columns - self.intrinsics.cx) / self.intrinsics.fx)
        value = self._value("depth", Kind.WRONG, "scale", 10.0)
        if value is not None:
            depth_m = depth_m * np.float32(value)
        value = self._value("depth", Kind.WRONG, "holes", 0.5)
        if value is not None:
            height, width = depth_m.shape
            rng = np.random.default_rng(number)
            holes = rng.random((height // _HOLE_PX, width // _HOLE_PX)) < value
            depth_m = np.where(np.kron(holes, np.ones((_HOLE_PX, _HOLE_PX), np.bool_)), np.float32(0), depth_m)
        if self._faults.find("depth", Kind.GARBAGE) is not None:
            depth_m = np.zeros_like(depth_m)
        return np.asarray(np.rint(np.minimum(depth_m / np.float32(DEPTH_UNIT_M), 65535)), np.uint16)

    def _spoil_color(self, color: Image) -> Image:
        if self._faults.find("color", Kind.GARBAGE) is not None:
            color = Image(color.number, color.t, color.pixels // np.uint8(_DARK))
        delay = self._value("color", Kind.DELAYED, "", 0.5)
        if delay is None:
            self._past_colors.clear()
            return color
        self._past_colors.append(color)
        while len(self._past_colors) > 1 and self._past_colors[1].t <= color.t - delay:
            self._past_colors.popleft()
        return self._past_colors[0]

    def _value(self, channel: str, kind: Kind, what: str, default: float) -> float | None:
        """The number of a fault, None while there is no such fault."""
        fault = self._faults.find(channel, kind, what)
        if fault is None:
            return None
        return default if fault.value is None else fault.value
