"""What a pinhole camera at a fixed place sees of a list of meshes: one ray per pixel, cast by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sim_twin.d415.open3d_core import load_open3d

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Intrinsics
    from sim_twin.visual import Visual

Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Hits:
    """What the rays of one frame met.

    Attributes:
        depth_m: (H, W) float32 [m] along the optical axis, 0 = nothing.
        triangle: (H, W) int32, index into the two tables below, -1 = nothing (which is their last row).
        visual_of: (T + 1,) int32, the visual that each triangle belongs to; -1 in the last row.
        normal_of: (T + 1, 3) float32, unit normals in base on the side of the camera; 0 in the last row.
        range_of: (T + 1,) float32, distance [m] from camera to plane of each triangle; 0 in the last row.
        poses: (K, 4, 4), where the visuals were in base.
    """

    depth_m: Floats
    triangle: Indices
    visual_of: Indices
    normal_of: Floats
    range_of: Floats
    poses: Array

    def visual(self) -> Indices:
        """(H, W) index of the visual that each pixel sees, -1 for none."""
        return self.visual_of[self.triangle]

    def normals(self) -> Floats:
        """(H, W, 3) unit normals in base of what each pixel sees, towards the camera, 0 for nothing."""
        return self.normal_of[self.triangle]


class RayCaster:
    """Casts the rays of one camera.

    Open3D cannot move what it has indexed, so each frame transforms all vertices and builds a new scene of
    one geometry: 1 to 3 ms for the few thousand triangles of the cell.

    Args:
        visuals: what there is to see; their triangles may wind either way.
        intrinsics: pinhole model; the rays pass through the pixels' integer coordinates.
        T_base_camera: pose of the colour optical frame (4, 4).
        threads: that Embree may use.
    """

    def __init__(
        self, visuals: Sequence[Visual], intrinsics: Intrinsics, T_base_camera: Array, threads: int = 2
    ) -> None:
        self._open3d = load_open3d()
        self._threads = threads
        counts = [len(visual.vertices) for visual in visuals]
        starts = np.cumsum([0, *counts[:-1]])
        self._vertices = np.concatenate([visual.vertices for visual in visuals], dtype=np.float32)
        self._visual_of_vertex = np.repeat(np.arange(len(visuals)), counts)
        self._triangles = np.concatenate(
            [visual.triangles + start for visual, start in zip(visuals, starts, strict=True)]
        ).astype(np.uint32)
        visual_of = np.repeat(np.arange(len(visuals)), [len(visual.triangles) for visual in visuals])
        self._visual_of = np.append(visual_of, -1).astype(np.int32)
        self._center = T_base_camera[:3, 3].astype(np.float32)
        self._rays = self._open3d.core.Tensor(_rays(intrinsics, T_base_camera))

    def cast(self, poses: Array) -> Hits:
        """One frame.

        Args:
            poses: (K, 4, 4) poses of the visuals in base.
        """
        vertices = self._in_base(poses)
        core = self._open3d.core
        scene = self._open3d.t.geometry.RaycastingScene(nthreads=self._threads)
        scene.add_triangles(core.Tensor(vertices), core.Tensor(self._triangles))
        answer = scene.cast_rays(self._rays, nthreads=self._threads)
        # The rays are 1 m long along the optical axis, so the ray parameter is the depth.
        depth = answer["t_hit"].numpy()
        depth[np.isinf(depth)] = 0.0
        corners = vertices[self._triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
        ranges = np.einsum("ij,ij->i", normals, self._center - corners[:, 0])
        normals[ranges < 0] *= -1.0
        return Hits(
            depth_m=depth,
            # Embree's "no hit" is the largest uint32, which reads as -1.
            triangle=answer["primitive_ids"].numpy().view(np.int32),
            visual_of=self._visual_of,
            normal_of=np.append(normals, np.zeros((1, 3), np.float32), axis=0),
            range_of=np.append(np.abs(ranges), np.float32(0)),
            poses=poses,
        )

    def _in_base(self, poses: Array) -> Floats:
        T = poses.astype(np.float32)[self._visual_of_vertex]
        rotated = np.einsum("nij,nj->ni", T[:, :3, :3], self._vertices)
        return np.ascontiguousarray(rotated + T[:, :3, 3], dtype=np.float32)


def _rays(intrinsics: Intrinsics, T_base_camera: Array) -> Floats:
    """(H, W, 6) origins and directions in base, the directions 1 m along the optical axis."""
    directions = ray_directions(intrinsics) @ T_base_camera[:3, :3].T
    origins = np.broadcast_to(T_base_camera[:3, 3], directions.shape)
    return np.concatenate([origins, directions], axis=2, dtype=np.float32)


def ray_directions(intrinsics: Intrinsics) -> Array:
    """(H, W, 3) directions of the pixels in the camera frame, scaled to 1 along the optical axis."""
    u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    x = (u - intrinsics.cx) / intrinsics.fx
    y = (v - intrinsics.cy) / intrinsics.fy
    return np.stack([x, y, np.ones_like(x)], axis=2)
