"""How high things may stand: for every place that the camera looks at, the height above which it saw past.

A thing that stands on the table hides the table beneath it and what lies behind it. So the map follows each column up
from the table: as long as the camera did not see past a point of it, something may stand there. What is seen, what is
hidden in a shadow and what gives no return at all thus all have a height, which the rays of the camera bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import KeepOut
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import RgbdFrame
    from robotcell.perception.calibrated_camera import CalibratedCamera

# What the camera did not look at may be as tall as the tallest block.
TALLEST_BLOCK_M = 0.100

RESOLUTION_M = 0.005
# Columns are followed in these steps, from a height below which nothing counts: the noise of the table, and its largest
# offset that a configuration usually allows (6 mm).
_LOWEST_M = 0.020
_STEP_M = 0.005
# A point counts as passed when every return around it is farther by this: 2.5 times the depth noise of a D415 at 1 m.
_PAST_M = 0.005
# Returns are taken from this many pixels around a point, which cover a cell 0.7 m away and close single drop-outs.
_FOOTPRINT_PX = 5
# A return that is nearer by this than a point whose column leaves the picture belongs to something before it.
_BEFORE_M = 0.03
# What reaches out of the picture at its top is taken to be this deep, seen from the camera.
_DEEPEST_M = 0.15
# Columns of the image at its border that hold no return at all are the invalid band of a stereo camera. It is part of
# what the camera does not look at.
_BAND_SHARE = 0.02
# Around known furniture, which stands so far from where its file has it, what is higher than it is looked for.
_FURNITURE_M = 0.03
# The map reaches so far beyond what the camera looks at.
_MARGIN_M = 0.10
# The foot of the arm and its turning shoulder reach so far from its axis.
_BASE_M = 0.25
# Farther from the base than this (the arm's reach and its tool) nothing is looked for.
_REACH_M = 1.20
# Distances to what is higher are kept in these steps up to where blocks end, and in coarser ones above.
_FINE_LEVELS_M = np.arange(_LOWEST_M, 0.120, 0.010)
_COARSE_LEVEL_M = 0.020


@dataclass(frozen=True, eq=False)
class ClearanceMap:
    """Up to which height something may stand, by place. Rows run along base y, columns along base x.

    Attributes:
        origin: (x, y) of the corner of cell (0, 0), base frame [m].
        ceiling_m: (H, W) float32, height above the table [m] up to which something may stand; 0 = bare table.
        looked_at: (H, W) whether the camera looked at the foot of the cell; elsewhere the ceiling is `TALLEST_BLOCK_M`.
        open_top: (H, W) whether what stands there reaches out of the picture: it may be taller than any height.
        table_height_m: z of the table, base frame.
    """

    origin: tuple[float, float]
    ceiling_m: npt.NDArray[np.float32]
    looked_at: npt.NDArray[np.bool_]
    open_top: npt.NDArray[np.bool_]
    table_height_m: float

    def gaps(self, points: Array, radius: npt.NDArray[np.floating], above_m: float, far_m: float) -> Array:
        """How far (N,) [m] spheres are from what may stand on the table; `far_m` where they are farther.

        Args:
            points: centres (N, 3), base frame [m].
            radius: (N,) [m].
            above_m: columns that end lower than this do not count.
            far_m: distance beyond which it does not matter.
        """
        gaps = np.full(len(points), far_m)
        height = points[:, 2] - self.table_height_m
        near = np.flatnonzero(height - radius - far_m < self._levels[-1])
        if not near.size:
            return gaps
        rows, cols = self.ceiling_m.shape
        col = np.floor((points[near, 0] - self.origin[0]) / RESOLUTION_M).astype(np.intp)
        row = np.floor((points[near, 1] - self.origin[1]) / RESOLUTION_M).astype(np.intp)
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        if above_m < TALLEST_BLOCK_M:
            # The arm's own base stands where nothing else can.
            beyond = near[~inside & (np.hypot(points[near, 0], points[near, 1]) > _BASE_M)]
            gaps[beyond] = np.minimum(far_m, height[beyond] - TALLEST_BLOCK_M - radius[beyond])
        near, row, col = near[inside], row[inside], col[inside]
        first = int(np.searchsorted(self._levels, above_m, side="right"))
        if first == len(self._levels):
            return gaps
        cell = row * cols + col
        beside = self._distances[cell, first] < radius[near] + far_m
        near, cell = near[beside], cell[beside]
        if near.size:
            across = self._distances[cell, first:]
            up = np.maximum(0.0, height[near, None] - self._levels[first:])
            gaps[near] = np.minimum(far_m, np.sqrt((across * across + up * up).min(axis=1)) - radius[near])
        return gaps

    def widened(self, by_m: float) -> ClearanceMap:
        """The map with all that the camera saw so much wider to all sides and higher [m]."""
        size = 2 * int(np.ceil(by_m / RESOLUTION_M)) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        ceiling = np.asarray(cv2.dilate(np.where(self.looked_at, self.ceiling_m, np.float32(0)), disc), np.float32)
        ceiling[ceiling > 0] += np.float32(by_m)
        ceiling = np.maximum(ceiling, self.ceiling_m)
        open_top = cv2.dilate(self.open_top.astype(np.uint8), disc) > 0
        return replace(self, ceiling_m=ceiling, open_top=open_top)

    @cached_property
    def top_m(self) -> float:
        """Height above the table [m] above which nothing stands."""
        return float(self._levels[-1])

    def looks_at(self, x: float, y: float) -> bool:
        """Whether the camera looked at the table at a place of the base frame [m]."""
        row, col = (int((v - o) // RESOLUTION_M) for v, o in ((y, self.origin[1]), (x, self.origin[0])))
        rows, cols = self.looked_at.shape
        return 0 <= row < rows and 0 <= col < cols and bool(self.looked_at[row, col])

    def tallest_near(self, x: float, y: float, reach_m: float, above_m: float) -> tuple[float, float, float, bool]:
        """The top of what stands nearest to a place: its x, y, its height above the table [m], and if it is open.

        Args:
            x: of the place, base frame [m].
            y: likewise.
            reach_m: half the side of the square.
            above_m: cells that end lower do not count, unless there is no other.
        """
        rows, cols = self.ceiling_m.shape
        middle = np.array([(y - self.origin[1]) / RESOLUTION_M, (x - self.origin[0]) / RESOLUTION_M])
        low = np.floor(middle - reach_m / RESOLUTION_M).astype(int)
        high = np.ceil(middle + reach_m / RESOLUTION_M).astype(int)
        r, c = np.mgrid[max(low[0], 0) : min(high[0], rows), max(low[1], 0) : min(high[1], cols)]
        if not r.size:
            return x, y, TALLEST_BLOCK_M, False
        ceiling = self.ceiling_m[r, c]
        high_cells = ceiling > max(above_m, 0.0)
        if not high_cells.any():
            return x, y, float(ceiling.max()), False
        distance = np.hypot(r + 0.5 - middle[0], c + 0.5 - middle[1])
        # Of the columns that are in the way the nearest is named, by the tallest of its surroundings.
        nearest = np.unravel_index(np.where(high_cells, distance, np.inf).argmin(), r.shape)
        around = np.hypot(r - r[nearest], c - c[nearest]) * RESOLUTION_M < 0.03
        best = np.unravel_index(np.where(around, ceiling, -1.0).argmax(), r.shape)
        row, col = int(r[best]), int(c[best])
        return (
            self.origin[0] + (col + 0.5) * RESOLUTION_M,
            self.origin[1] + (row + 0.5) * RESOLUTION_M,
            float(self.ceiling_m[row, col]),
            bool(self.open_top[row, col]),
        )

    @cached_property
    def _levels(self) -> Array:
        """Upper ends (K,) [m] of the classes of height; the last holds the highest cell."""
        top = float(self.ceiling_m.max(initial=TALLEST_BLOCK_M)) + 1e-6
        coarse = np.arange(_FINE_LEVELS_M[-1] + _COARSE_LEVEL_M, top + _COARSE_LEVEL_M, _COARSE_LEVEL_M)
        levels = np.concatenate([_FINE_LEVELS_M, coarse])
        return np.asarray(levels[: int(np.searchsorted(levels, top)) + 1])

    @cached_property
    def _distances(self) -> npt.NDArray[np.float32]:
        """(H * W, K) horizontal distance [m] from each cell to the nearest one of this class of height or a higher one.

        It is of the cells' nearest corners, so that no place of either cell is nearer.
        """
        below = np.concatenate([[_LOWEST_M / 2], self._levels[:-1]])
        distances = np.empty((len(below), *self.ceiling_m.shape), np.float32)
        for level, low in enumerate(below):
            free = (self.ceiling_m <= low).astype(np.uint8)
            if free.all():
                distances[level] = np.inf
            else:
                distances[level] = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        nearest = np.maximum(0.0, (distances - np.float32(np.sqrt(2))) * np.float32(RESOLUTION_M))
        return np.ascontiguousarray(nearest.reshape(len(below), -1).T)


def build_clearance_map(
    frame: RgbdFrame,
    camera: CalibratedCamera,
    table_height_m: float,
    furniture: Sequence[KeepOut],
    own: npt.NDArray[np.bool_] | None = None,
) -> ClearanceMap:
    """What may stand on the table, by a frame.

    Args:
        frame: with registered depth.
        camera: that took it, as its calibration has it.
        table_height_m: z of the table in the base frame.
        furniture: boxes that stand on the table and are known: there columns are followed up from their tops.
        own: (Himg, Wimg) pixels that may show the arm or what it holds: what they hide was not looked at. None where
            the arm is in no picture.

    Raises:
        CalibrationError: the frame is of another resolution than the calibration.
    """
    sight = _sight(frame, camera, own)
    origin, shape = _extent(frame, camera, table_height_m)
    rows, cols = shape
    x = origin[0] + (np.arange(cols) + 0.5) * RESOLUTION_M
    y = origin[1] + (np.arange(rows) + 0.5) * RESOLUTION_M
    places = np.stack([grid.ravel() for grid in np.meshgrid(x, y)], axis=-1)
    height = np.full(len(places), _LOWEST_M)
    for box in furniture:
        (x0, x1), (y0, y1) = box.x, box.y
        middle, half = ((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2 + _FURNITURE_M, (y1 - y0) / 2 + _FURNITURE_M)
        standing = (np.abs(places - middle) < half).all(axis=1)
        height[standing] = np.maximum(height[standing], box.z[1] - table_height_m + _LOWEST_M)

    def look(cells: npt.NDArray[np.intp]) -> _Looks:
        return sight.look(np.column_stack([places[cells], table_height_m + height[cells]]))

    ceiling = np.zeros(len(places), np.float32)
    open_top, left_hidden = np.zeros(len(places), np.bool_), np.zeros(len(places), np.bool_)
    first = look(np.arange(len(places)))
    looked_at = first.within & ~first.veiled
    ceiling[~looked_at & (np.hypot(*places.T) > _BASE_M)] = TALLEST_BLOCK_M
    # Whether a column was last followed through a surface, rather than through the shadow of something.
    surface = first.surface.copy()
    camera_m = float(camera.position[2]) - table_height_m
    hidden = np.flatnonzero(looked_at & ~first.passed)
    while hidden.size:
        height[hidden] += _STEP_M
        looks = look(hidden)
        out = ~looks.within | looks.veiled | (height[hidden] >= camera_m)
        # Where the picture ends below that height, the rest is taken for what stands beside the picture.
        open_top[hidden[out & surface[hidden] & (height[hidden] >= TALLEST_BLOCK_M)]] = True
        left_hidden[hidden[out]] = True
        cut_off = looks.veiled | (out & surface[hidden])
        ceiling[hidden] = np.where(cut_off, np.maximum(height[hidden], TALLEST_BLOCK_M), height[hidden])
        surface[hidden[~out]] = looks.surface[~out]
        hidden = hidden[~out & ~looks.passed]
    top = open_top.reshape(shape)
    if top.any():
        reach = 2 * round(_DEEPEST_M / RESOLUTION_M) + 1
        deep = cv2.dilate(top.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
        top = deep & left_hidden.reshape(shape)
        ceiling[top.ravel()] = camera_m
    return ClearanceMap(origin, ceiling.reshape(shape), looked_at.reshape(shape), top, table_height_m)


class _Looks(NamedTuple):
    """What the camera sees at points, all (N,): are they in its picture, does it see past them, or a surface there?

    `veiled` are those in its picture that the arm may hide.
    """

    within: npt.NDArray[np.bool_]
    passed: npt.NDArray[np.bool_]
    surface: npt.NDArray[np.bool_]
    veiled: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _Sight:
    """A frame as it is asked about points of the base frame.

    Attributes:
        nearest_m: (H, W) the nearest return around each pixel [m]; infinite where there is none.
        valid: (H, W) pixels through which the camera looks.
        own: (H, W) those that may show the arm or what it holds.
        frame, camera: that took it.
    """

    nearest_m: npt.NDArray[np.float32]
    valid: npt.NDArray[np.bool_]
    own: npt.NDArray[np.bool_]
    frame: RgbdFrame
    camera: CalibratedCamera

    def look(self, points: Array) -> _Looks:
        """What the camera sees at points (N, 3) of the base frame."""
        u, v, depth = self.camera.project(points, self.frame.intrinsics).T
        rows, cols = self.valid.shape
        with np.errstate(invalid="ignore"):
            col, row = np.rint(u), np.rint(v)
            within = (depth > 0) & (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        pixel = row[within].astype(np.intp), col[within].astype(np.intp)
        seen = np.full(len(points), np.inf)
        seen[within] = self.nearest_m[pixel]
        passed = np.isfinite(seen) & (seen > depth + _PAST_M)
        veiled = np.zeros(len(points), np.bool_)
        veiled[within] = self.own[pixel]
        within[within] = self.valid[pixel]
        return _Looks(within, passed, np.abs(seen - depth) < _BEFORE_M, within & veiled & ~passed)


def _sight(frame: RgbdFrame, camera: CalibratedCamera, own: npt.NDArray[np.bool_] | None) -> _Sight:
    depth = camera.depth_m(frame)
    # No return hides what is behind it only where nothing around it returned either.
    returns = np.where(depth > 0, depth, np.float32(np.inf))
    nearest = cv2.erode(returns, np.ones((_FOOTPRINT_PX, _FOOTPRINT_PX), np.uint8))
    valid = np.zeros(depth.shape, np.bool_)
    first, last = _valid_columns(depth)
    valid[:, first:last] = True
    own = np.zeros(depth.shape, np.bool_) if own is None else own
    return _Sight(np.asarray(nearest, np.float32), valid, own, frame, camera)


def _valid_columns(depth: npt.NDArray[np.float32]) -> tuple[int, int]:
    """First and last column (exclusive) of the image without the invalid bands at its left and its right."""
    valid = np.flatnonzero((depth > 0).mean(axis=0) > _BAND_SHARE)
    return (int(valid[0]), int(valid[-1]) + 1) if valid.size else (0, 0)


def _extent(
    frame: RgbdFrame, camera: CalibratedCamera, table_height_m: float
) -> tuple[tuple[float, float], tuple[int, int]]:
    """Corner (x, y) [m] and shape (rows, columns) of a map of all that the camera looks at and the arm reaches."""
    size = frame.intrinsics
    rays = camera.rays(size, (slice(0, size.height, size.height - 1), slice(0, size.width, size.width - 1)))
    down = np.minimum(rays[2], -1e-3)
    at = camera.position[:2, None, None] + (table_height_m - camera.position[2]) / down * rays[:2]
    low = np.maximum(at.reshape(2, -1).min(axis=1) - _MARGIN_M, -_REACH_M)
    high = np.minimum(at.reshape(2, -1).max(axis=1) + _MARGIN_M, _REACH_M)
    cols, rows = (max(1, int(n)) for n in np.ceil((high - low) / RESOLUTION_M))
    return (float(low[0]), float(low[1])), (rows, cols)
