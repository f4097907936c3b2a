"""Pinhole projection with OpenCV's distortion and its derivatives, and all views' corners as one padded stack."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from calibration.solve.views import Corners
    from robotcell.config.calibration_file import CameraModel, Point
    from robotcell.geometry.transforms import Array

# fx fy cx cy k1 k2 p1 p2 k3
INTRINSICS = 9
# Points behind the camera, which a bad start can produce, are projected as if they were this far in front [m].
_NEAR = 1e-3


@dataclass(frozen=True)
class CornerStack:
    """The corners of V views, padded to K each.

    Attributes:
        points: (V, K, 3) in the board frame, moved so that the mean of the board's corners is the origin [m].
        px: (V, K, 2) where they are in the image [px].
        seen: (V, K) 1.0 where there is a corner, 0.0 for padding.
        center: (3,) mean of the board's corners in the board frame [m].
    """

    points: Array
    px: Array
    seen: Array
    center: Array

    @property
    def counts(self) -> Array:
        """(V,) corners of each view."""
        return np.asarray(self.seen.sum(axis=1))

    def subset(self, indices: npt.NDArray[np.intp]) -> CornerStack:
        """Some of the views, in the given order."""
        return CornerStack(self.points[indices], self.px[indices], self.seen[indices], self.center)


def stack_corners(corners: Sequence[Corners], board: dict[int, Point]) -> CornerStack:
    """Bring the corners of all views into one stack; every id must be on the board."""
    most = max((len(view.ids) for view in corners), default=0)
    center = np.mean(list(board.values()), axis=0)
    points, px = np.zeros((len(corners), most, 3)), np.zeros((len(corners), most, 2))
    seen = np.zeros((len(corners), most))
    for i, view in enumerate(corners):
        count = len(view.ids)
        points[i, :count] = np.array([board[int(corner)] for corner in view.ids]).reshape(-1, 3) - center
        px[i, :count] = view.px
        seen[i, :count] = 1.0
    return CornerStack(points, px, seen, center)


def intrinsics_vector(camera: CameraModel) -> Array:
    """(9,) fx fy cx cy k1 k2 p1 p2 k3."""
    dist = np.zeros(5)
    dist[: len(camera.dist)] = camera.dist
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *dist])


def project(points: Array, intrinsics: Array, *, derivatives: bool = True) -> tuple[Array, Array, Array]:
    """Pixels (..., 2), and their derivatives by the points (..., 2, 3) and by the intrinsics (..., 2, 9).

    Args:
        points: (..., 3) in the camera frame [m].
        intrinsics: (9,), or one set per view, broadcast against the leading axes of the points.
        derivatives: compute them; empty arrays otherwise.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(intrinsics, -1, 0)
    z = np.maximum(points[..., 2], _NEAR)
    x, y = points[..., 0] / z, points[..., 1] / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    px = np.stack([fx * xd + cx, fy * yd + cy], axis=-1)
    if not derivatives:
        return px, np.empty(0), np.empty(0)
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
    xd_x = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xd_y = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yd_x = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yd_y = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    by_point = np.empty((*px.shape, 3))
    by_point[..., 0, 0], by_point[..., 0, 1] = fx * xd_x / z, fx * xd_y / z
    by_point[..., 1, 0], by_point[..., 1, 1] = fy * yd_x / z, fy * yd_y / z
    by_point[..., 0, 2] = -fx * (xd_x * x + xd_y * y) / z
    by_point[..., 1, 2] = -fy * (yd_x * x + yd_y * y) / z
    by_intrinsics = np.zeros((*px.shape, INTRINSICS))
    by_intrinsics[..., 0, 0], by_intrinsics[..., 1, 1] = xd, yd
    by_intrinsics[..., 0, 2] = by_intrinsics[..., 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2**2), (8, r2**3)):
        by_intrinsics[..., 0, column], by_intrinsics[..., 1, column] = fx * x * power, fy * y * power
    by_intrinsics[..., 0, 6], by_intrinsics[..., 1, 6] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    by_intrinsics[..., 0, 7], by_intrinsics[..., 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * x * y
    return px, by_point, by_intrinsics
