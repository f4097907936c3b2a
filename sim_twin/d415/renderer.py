"""What a D415 at a fixed place delivers of a list of meshes: rays, shading, and the errors of the device."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.geometry.transforms import invert_transform, transform_points
from robotcell.interfaces import Intrinsics
from sim_twin.d415.noise import degrade_color, degrade_depth
from sim_twin.d415.rays import Hits, RayCaster, ray_directions
from sim_twin.options import DepthError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CameraMount
    from robotcell.geometry.transforms import Array
    from sim_twin.options import TwinOptions
    from sim_twin.visual import Visual

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

FRAMES_PER_S = 30
# Of the twin's camera.
SERIAL = "000000000415"

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
# A textured pixel is the mean of this many parts along each side: its edges then lie within 0.02 px of the truth.
_PIXEL_PARTS = 4


def reported_intrinsics(resolution: str, options: TwinOptions) -> Intrinsics:
    """What the camera says of its intrinsics in a mode; it sees with those in `MODES`."""
    optics, error = MODES[resolution], options.intrinsics_error
    return replace(
        optics,
        fx=optics.fx * (1 + error.focal),
        fy=optics.fy * (1 + error.focal),
        cx=optics.cx + error.cx_px,
        cy=optics.cy + error.cy_px,
    )


class Renderer:
    """Renders one list of meshes for one camera; the perfect image first, then what the device makes of it.

    Args:
        visuals: what there is to see.
        mount: resolution and place of the camera.
        options: which errors the device makes, and how far it stands from its place; the same seed and frame number
            give the same errors.

    Attributes:
        intrinsics: with which the camera sees.
        reported_intrinsics: those that it reports.
    """

    def __init__(self, visuals: Sequence[Visual], mount: CameraMount, options: TwinOptions) -> None:
        self.visuals = visuals
        self.intrinsics = MODES[mount.resolution]
        self.reported_intrinsics = reported_intrinsics(mount.resolution, options)
        self._min_depth_m = _MIN_DEPTH_M[mount.resolution]
        self._noise = options.noise
        self._seed = options.seed
        self._depth_error = options.depth_error
        self._T_base_camera = options.camera_pose(mount)
        self._caster = RayCaster(visuals, self.intrinsics, self._T_base_camera)
        # Metres along each pixel's ray for a metre of depth.
        self._pixel_range = np.linalg.norm(ray_directions(self.intrinsics), axis=2).astype(np.float32)
        self._palette = np.array([*(visual.color for visual in visuals), (0, 0, 0)], dtype=np.float64)

    def cast(self, poses: Array) -> Hits:
        """What each pixel meets.

        Args:
            poses: (K, 4, 4) poses of the visuals in base.
        """
        return self._caster.cast(poses)

    def incidence_cos(self, hits: Hits) -> Floats:
        """(H, W): the distance to a triangle's plane over the distance along the ray, 0 for nothing."""
        along_ray = hits.depth_m * self._pixel_range
        return np.asarray(
            np.divide(np.take(hits.range_of, hits.triangle), along_ray, out=along_ray, where=along_ray > 0)
        )

    def color(self, hits: Hits) -> Bytes:
        """(H, W, 3) RGB: each triangle has one shade, by how it faces the lamps; black for nothing.

        A textured rectangle has its texture instead of one colour, averaged over the area of each pixel.
        """
        shade = _AMBIENT + (1 - _AMBIENT) * np.maximum(hits.normal_of @ _LIGHT, 0)
        # Four bytes for each triangle, so that a pixel is fetched as one number.
        of_triangle = np.zeros((len(shade), 4), dtype=np.uint8)
        of_triangle[:, :3] = np.rint(self._palette[hits.visual_of] * shade[:, None])
        pixels = np.take(of_triangle.view(np.uint32)[:, 0], hits.triangle)
        image = pixels.view(np.uint8).reshape(*pixels.shape, 4)
        color = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
        for index, visual in enumerate(self.visuals):
            if visual.texture is not None:
                self._lay_texture(color, hits, index, shade)
        return color

    def _lay_texture(self, color: Bytes, hits: Hits, index: int, shade: Array) -> None:
        """Put the texture of a rectangle onto the pixels that see it. In place."""
        visual = self.visuals[index]
        seen = hits.visual() == index
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if visual.texture is None or not len(rows):
            return
        top, left, height, width = rows[0], columns[0], np.ptp(rows) + 1, np.ptp(columns) + 1
        T_camera_visual = invert_transform(self._T_base_camera) @ hits.poses[index]
        corners = transform_points(T_camera_visual, visual.vertices.astype(np.float64))
        # From the texture's pixels to the rectangle, to the image, to the parts of the pixels of its crop.
        texture_height, texture_width = visual.texture.shape[:2]
        across, down = (corners[1] - corners[0]) / texture_width, (corners[3] - corners[0]) / texture_height
        plane = np.column_stack([across, down, corners[0] + (across + down) / 2])
        optics = self.intrinsics
        K = np.array([[optics.fx, 0, optics.cx], [0, optics.fy, optics.cy], [0, 0, 1]])
        n = _PIXEL_PARTS
        to_parts = np.array([[n, 0, n * (0.5 - left) - 0.5], [0, n, n * (0.5 - top) - 0.5], [0, 0, 1]])
        parts = cv2.warpPerspective(
            visual.texture,
            to_parts @ K @ plane,
            (int(n * width), int(n * height)),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        pixels = cv2.resize(parts, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        crop = seen[top : top + height, left : left + width]
        facing = shade[hits.triangle[rows[0], np.flatnonzero(seen[rows[0]])[0]]]
        color[top : top + height, left : left + width][crop] = np.rint(pixels[crop] * facing)

    def measured_depth(self, depth_m: Floats, incidence_cos: Floats, frame: int) -> Floats:
        """(H, W) [m], 0 = no return: what the device reports of a true depth in one frame."""
        inside = (depth_m >= self._min_depth_m) & (depth_m <= _MAX_DEPTH_M)
        in_range = np.where(inside, depth_m, np.float32(0))
        depth = degrade_depth(in_range, incidence_cos, self.intrinsics, self._noise, seed=self._seed, frame=frame)
        if self._depth_error != DepthError():
            off = np.float32(self._depth_error.scale) * depth + np.float32(self._depth_error.offset_m)
            depth = np.where(depth > 0, off, depth)
        return depth

    def measured_color(self, color: Bytes, frame: int, t: float, frames_since_start: int) -> Bytes:
        """(H, W, 3): what the device reports of true colours in one frame; arguments as in `degrade_color`."""
        return degrade_color(
            color, self._noise, seed=self._seed, frame=frame, t=t, frames_since_start=frames_since_start
        )
