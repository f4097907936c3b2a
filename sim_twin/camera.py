"""The twin's D415: renders what the camera would see of the world, and degrades it as the device does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.errors import ConnectionLost
from robotcell.interfaces import Camera, Intrinsics, RgbdFrame
from sim_twin.noise import WARM_UP_FRAMES, NoiseOptions, degrade_color, degrade_depth
from sim_twin.raycast import Hits, Indices, RayCaster, load_open3d, ray_directions
from sim_twin.world import STEP_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CameraMount
    from sim_twin.world import Visual, World

FRAMES_PER_S = 30
_STEPS_PER_FRAME = round(1 / (FRAMES_PER_S * STEP_S))

# A D415's colour stream sees 69.3 x 42.5 degrees at 16:9 (datasheet 69 x 42; read from a unit in
# librealsense issue 4179): a focal length of 926 px at 1280x720. 640x480 is cut out of the same image and
# scaled by 2/3. The principal points of units lie some pixels off the middle.
MODES = {
    "640x480": Intrinsics(640, 480, 617.3, 617.3, 320.0, 240.0),
    "1280x720": Intrinsics(1280, 720, 926.0, 926.0, 640.0, 360.0),
}
# D400 series datasheet, minimum depth of the D415 by resolution, and its range "up to 10 m".
_MIN_DEPTH_M = {"640x480": 0.31, "1280x720": 0.45}
_MAX_DEPTH_M = 10.0

# Lamps above the cell: surfaces that face them are this much brighter than those that do not.
_LIGHT = np.array([0.15, -0.25, 0.95]) / np.linalg.norm([0.15, -0.25, 0.95])
_AMBIENT = 0.5


class TwinCamera(Camera):
    """A `Camera` that looks at a simulated world with the resolution, rate and errors of a D415.

    Frames come at 30 Hz of simulated time: `read()` lets the world run on by one frame. `connect()` lets the
    frames pass in which automatic exposure settles, as a driver of the device does. The frame number counts
    from the beginning of the world.

    Args:
        world: what there is to see.
        mount: resolution and place.
        noise: which errors of the device to make.
        seed: of the errors; the same seed at the same time gives the same frame.
    """

    def __init__(self, world: World, mount: CameraMount, noise: NoiseOptions, seed: int) -> None:
        self._world = world
        self._mount = mount
        self._noise = noise
        self._seed = seed
        self._intrinsics = MODES[mount.resolution]
        self._first_frame: int | None = None
        self._caster: RayCaster | None = None
        self._cast_visuals: Sequence[Visual] = ()
        # Metres along each pixel's ray for a metre of depth; filled when the stream starts.
        self._pixel_range = np.empty((0, 0), dtype=np.float32)

    def connect(self) -> None:
        """Start the stream and wait until its exposure has settled.

        Raises:
            ConfigError: open3d is not installed, or the world cannot be built.
        """
        if self._first_frame is not None:
            return
        load_open3d()
        self._world.attach(self)
        try:
            self._prepare()
            self._pixel_range = np.linalg.norm(ray_directions(self._intrinsics), axis=2).astype(np.float32)
            self._first_frame = self._frame_number()
            if self._noise.warm_up:
                self._world.step(WARM_UP_FRAMES * _STEPS_PER_FRAME)
        except BaseException:
            self._first_frame = None
            self._world.detach(self)
            raise

    def close(self) -> None:
        """Stop the stream."""
        if self._first_frame is not None:
            self._first_frame = None
            self._world.detach(self)
        self._caster = None

    def read(self) -> RgbdFrame:
        """The next frame.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        return self.read_with_truth()[0]

    def read_with_truth(self) -> tuple[RgbdFrame, Indices]:
        """The next frame, and the index (H, W) into `world.visuals()` of what each pixel really shows, -1 = nothing.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        first_frame = self._connected()
        self._world.step(_STEPS_PER_FRAME)
        t, number = self._world.time_s, self._frame_number()
        hits = self._cast()
        depth = degrade_depth(
            self._in_range(hits.depth_m),
            self._incidence_cos(hits),
            self._intrinsics,
            self._noise,
            seed=self._seed,
            frame=number,
        )
        color = degrade_color(
            self._color(hits),
            self._noise,
            seed=self._seed,
            frame=number,
            t=t,
            frames_since_start=number - first_frame,
        )
        frame = RgbdFrame(t=t, number=number, color=color, depth_m=depth, intrinsics=self._intrinsics)
        return frame, hits.visual()

    def render_truth(self) -> tuple[npt.NDArray[np.float32], Indices]:
        """What is really in front of the camera now: for scores, labels and tests, never for a decision.

        Returns:
            Depth (H, W) [m] along the optical axis, 0 = nothing, and the index (H, W) into `world.visuals()`,
            -1 = nothing. No noise, no limit of range, and no time passes.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        self._connected()
        hits = self._cast()
        return hits.depth_m, hits.visual()

    def _connected(self) -> int:
        if self._first_frame is None:
            raise ConnectionLost("the twin's camera is not connected; call connect() first")
        return self._first_frame

    def _frame_number(self) -> int:
        return round(self._world.time_s / STEP_S) // _STEPS_PER_FRAME

    def _prepare(self) -> RayCaster:
        visuals = self._world.visuals()
        if self._caster is None or visuals is not self._cast_visuals:
            self._caster = RayCaster(visuals, self._intrinsics, self._mount.pose())
            self._cast_visuals = visuals
        return self._caster

    def _cast(self) -> Hits:
        return self._prepare().cast(self._world.visual_poses())

    def _in_range(self, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        inside = (depth_m >= _MIN_DEPTH_M[self._mount.resolution]) & (depth_m <= _MAX_DEPTH_M)
        return np.where(inside, depth_m, np.float32(0))

    def _incidence_cos(self, hits: Hits) -> npt.NDArray[np.float32]:
        """(H, W): the distance to a triangle's plane over the distance along the ray, 0 for nothing."""
        along_ray = hits.depth_m * self._pixel_range
        return np.asarray(
            np.divide(np.take(hits.range_of, hits.triangle), along_ray, out=along_ray, where=along_ray > 0)
        )

    def _color(self, hits: Hits) -> npt.NDArray[np.uint8]:
        """(H, W, 3): each triangle has one shade, by how it faces the lamps; black for nothing."""
        palette = np.array([*(visual.color for visual in self._cast_visuals), (0, 0, 0)], dtype=np.float64)
        shade = _AMBIENT + (1 - _AMBIENT) * np.maximum(hits.normal_of @ _LIGHT, 0)
        # Four bytes for each triangle, so that a pixel is fetched as one number.
        of_triangle = np.zeros((len(shade), 4), dtype=np.uint8)
        of_triangle[:, :3] = np.rint(palette[hits.visual_of] * shade[:, None])
        pixels = np.take(of_triangle.view(np.uint32)[:, 0], hits.triangle)
        image = pixels.view(np.uint8).reshape(*pixels.shape, 4)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
