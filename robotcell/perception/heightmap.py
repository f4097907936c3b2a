"""The table from above: an RGB-D frame as an orthographic map of height and colour."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.perception.calibrated_camera import CalibratedCamera

if TYPE_CHECKING:
    from collections.abc import Mapping

    from robotcell.config import Workspace
    from robotcell.config.calibration_file import CameraModel
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Intrinsics, RgbdFrame

# Returns outside this band above the table [m] are not of things that stand on it: a lamp, reflections in the table
# top. The upper end is as high as the tool may go by default (`limits.z`); the lower one leaves room for the largest
# table offset that a configuration may allow (5 cm).
BAND_M = (-0.10, 0.70)

# An unknown cell with this many known neighbours of eight lies in a gap between pixels, not in a shadow, whose
# straight edge has three.
_GAP_NEIGHBOURS = 5
# Gaps close from their rims this many times over: up to 6 cells, 12 mm at 2 mm resolution.
_GAP_ROUNDS = 3

# The table is sought among about this many returns, regularly spaced: enough for a tenth of a millimetre.
_TABLE_SAMPLES = 20_000
# Bins of the search for the table's level; then the distances to the plane within which it is fitted, from
# coarse to fine. The last is three times the depth noise of a D415 at 1 m (about 2 mm).
_TABLE_BIN_M = 0.004
_TABLE_BAND_M = (0.015, 0.010, 0.006)
# Below this share of the workspace, what looks like table may be an object's top.
_TABLE_SHARE = 0.10

_Value = TypeVar("_Value", bound=np.generic)


@dataclass(frozen=True)
class TablePlane:
    """The plane through the returns of the table, relative to the configured table height.

    Attributes:
        tilt_rad: angle between the plane and the horizontal.
        offset_m: height of the plane over the configured one at the centre of the workspace.
        rms_m: root mean square distance of its returns, the noise of the depth image.
    """

    tilt_rad: float
    offset_m: float
    rms_m: float


@dataclass(frozen=True)
class Heightmap:
    """The workspace from above. Rows run along base y, columns along base x.

    Attributes:
        workspace: the rectangle, and from it the position of each cell.
        color: (H, W, 3) uint8 RGB of the highest return of each cell; black where none fell.
        height_m: (H, W) float32, the highest return of each cell above the configured table height [m];
            NaN = never seen.
        table: the table as it was measured; None when too little of it is seen.
        coverage: share of cells that were seen, 0..1.
        masks: (H, W) bool by name: the image masks at the highest return of each cell; False where none fell.
        t: time of the frame [s].
    """

    workspace: Workspace
    color: npt.NDArray[np.uint8]
    height_m: npt.NDArray[np.float32]
    table: TablePlane | None
    coverage: float
    masks: Mapping[str, npt.NDArray[np.bool_]]
    t: float

    @cached_property
    def closed_m(self) -> npt.NDArray[np.float32]:
        """`height_m` with the gaps between pixels closed (`close_gaps`); read-only."""
        closed = close_gaps(self.height_m)
        closed.flags.writeable = False
        return closed

    @cached_property
    def filled_m(self) -> npt.NDArray[np.float32]:
        """The heights (H, W) [m] without NaN, for what cannot work with unknown cells; read-only.

        Gaps between pixels take the highest of their neighbours (`close_gaps`), so that they close at the height
        of what surrounds them. What is still unknown (the shadow behind an object, the world beyond the image)
        takes the table's level 0, the only value that does not invent an object. Whoever plans a motion must
        therefore ask `height_m` whether a cell was seen at all.
        """
        filled = np.nan_to_num(self.closed_m, nan=0.0)
        filled.flags.writeable = False
        return filled


def close_gaps(height_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """A copy of (H, W) heights without the gaps that drop-out and an oblique view leave between pixels.

    A NaN with at least five known neighbours of eight takes the highest of them; three times over. The straight
    edge of a shadow has three and stays where it is: what is large and unknown remains NaN.
    """
    unknown = np.isnan(height_m)
    heights = np.where(unknown, np.float32(-1), height_m)
    kernel = np.ones((3, 3), np.uint8)
    for _ in range(_GAP_ROUNDS):
        known = (~unknown).astype(np.uint8)
        count = cv2.boxFilter(known, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        gaps = unknown & (count >= _GAP_NEIGHBOURS)
        if not gaps.any():
            break
        heights[gaps] = cv2.dilate(heights, kernel)[gaps]
        unknown &= ~gaps
    heights[unknown] = np.nan
    return heights


def upper_height(height_m: npt.NDArray[np.float32], percent: int) -> float:
    """The height that so many percent (0 to 99) of heights (N,), N > 0, do not exceed: a top without its noise."""
    rank = len(height_m) * percent // 100
    return float(np.partition(height_m, rank)[rank])


def build_heightmap(
    frame: RgbdFrame,
    camera: CalibratedCamera,
    workspace: Workspace,
    table_height_m: float,
    masks: Mapping[str, npt.NDArray[np.bool_]] | None = None,
) -> Heightmap:
    """Project a frame along gravity: each cell takes the height, colour and masks of its highest return.

    Returns lower than 10 cm below the table or higher than 70 cm above it are left out (`BAND_M`). An arm that reaches
    into the view counts as something that stands there.

    Args:
        frame: colour and registered depth.
        camera: that took it, as its calibration has it.
        workspace: the rectangle of the base frame that the map covers.
        table_height_m: z of the table in the base frame.
        masks: (Himg, Wimg) bool images by name that are carried along.

    Raises:
        ValueError: an image does not have the size that the intrinsics say.
        CalibrationError: the frame is of another resolution than the calibration.
    """
    size = (frame.intrinsics.height, frame.intrinsics.width)
    masks = masks or {}
    images: dict[str, npt.NDArray[Any]] = {"color": frame.color, "depth_m": frame.depth_m, **masks}
    for name, image in images.items():
        if image.shape[:2] != size:
            raise ValueError(f"image {name!r} is {image.shape[:2]}; the intrinsics say {size} (height, width)")
    view = _view(frame.intrinsics, camera.T_base_camera.tobytes(), camera.model, workspace, table_height_m)
    rows, cols = workspace.shape

    depth = camera.depth_m(frame)[view.crop]
    with np.errstate(invalid="ignore", over="ignore"):
        col = depth * view.rays[0] + view.origin[0]
        row = depth * view.rays[1] + view.origin[1]
        height = depth * view.rays[2] + view.origin[2]
        inside = (depth > 0) & (height >= BAND_M[0]) & (height <= BAND_M[1])
        inside &= (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    pixel = np.flatnonzero(inside)
    col, row, height = col.ravel()[pixel], row.ravel()[pixel], height.ravel()[pixel]

    # The bits of a positive float32 order as the float does: one integer maximum finds height and pixel.
    order = (height - np.float32(2 * BAND_M[0])).view(np.int32).astype(np.int64)
    highest = np.full(rows * cols, -1, np.int64)
    np.maximum.at(
        highest,
        row.astype(np.int32) * np.int32(cols) + col.astype(np.int32),
        order << 32 | np.arange(len(pixel)),
    )
    seen = np.flatnonzero(highest >= 0)
    point = highest[seen] & 0xFFFFFFFF

    heights = np.full(rows * cols, np.nan, np.float32)
    heights[seen] = height[point]
    image_row, image_col = np.divmod(pixel[point], depth.shape[1]) if depth.size else (point, point)

    def carried(image: npt.NDArray[_Value]) -> npt.NDArray[_Value]:
        values = np.zeros((rows * cols, *image.shape[2:]), image.dtype)
        values[seen] = image[view.crop][image_row, image_col]
        return values.reshape(rows, cols, *image.shape[2:])

    return Heightmap(
        workspace=workspace,
        color=carried(frame.color),
        height_m=heights.reshape(rows, cols),
        table=_fit_table(col, row, height, workspace, len(seen)),
        coverage=len(seen) / (rows * cols),
        masks={name: carried(image) for name, image in masks.items()},
        t=frame.t,
    )


class _View(NamedTuple):
    """What stays the same from frame to frame. A point's (column, row, height) is depth * rays + origin."""

    crop: tuple[slice, slice]
    rays: npt.NDArray[np.float32]
    origin: npt.NDArray[np.float32]


@lru_cache(maxsize=4)
def _view(
    intrinsics: Intrinsics, pose: bytes, model: CameraModel | None, workspace: Workspace, table_height_m: float
) -> _View:
    camera = CalibratedCamera(np.frombuffer(pose).reshape(4, 4), model)
    crop = _crop(intrinsics, camera, workspace, table_height_m)
    scale = np.array([1 / workspace.resolution_m, 1 / workspace.resolution_m, 1.0])
    rays = scale[:, None, None] * camera.rays(intrinsics, crop)
    origin = scale * (camera.position - (workspace.x[0], workspace.y[0], table_height_m))
    return _View(crop, rays.astype(np.float32), origin.astype(np.float32))


def _crop(
    intrinsics: Intrinsics, camera: CalibratedCamera, workspace: Workspace, table_height_m: float
) -> tuple[slice, slice]:
    """Rows and columns of the image that can see into the workspace's box."""
    rows, cols = workspace.shape
    x = (workspace.x[0], workspace.x[0] + cols * workspace.resolution_m)
    y = (workspace.y[0], workspace.y[0] + rows * workspace.resolution_m)
    z = (table_height_m + BAND_M[0], table_height_m + BAND_M[1])
    u, v, depth = camera.project(np.array(list(product(x, y, z))), intrinsics).T
    if depth.min() <= 1e-3:
        return slice(0, intrinsics.height), slice(0, intrinsics.width)  # the box reaches behind the camera
    return _span(v, intrinsics.height), _span(u, intrinsics.width)


def _span(pixels: Array, size: int) -> slice:
    first, last = np.clip([np.floor(pixels.min()) - 1, np.ceil(pixels.max()) + 2], 0, size)
    return slice(int(first), int(last))


def _fit_table(
    col: npt.NDArray[np.float32],
    row: npt.NDArray[np.float32],
    height: npt.NDArray[np.float32],
    workspace: Workspace,
    cells_seen: int,
) -> TablePlane | None:
    """Fit z = a x + b y + c through the returns near the most frequent height, from coarse to fine.

    It uses single returns: the highest of a cell lies above the table by about the noise.
    """
    rows, cols = workspace.shape
    step = max(1, len(height) // _TABLE_SAMPLES)
    x = (col[::step].astype(np.float64) - cols / 2) * workspace.resolution_m
    y = (row[::step].astype(np.float64) - rows / 2) * workspace.resolution_m
    z = height[::step].astype(np.float64)
    if len(z) < 3:
        return None
    low = -BAND_M[0]
    counts = np.convolve(
        np.bincount(((z[z < low] + low) / _TABLE_BIN_M).astype(np.int64), minlength=3), np.ones(3), "same"
    )
    coefficients = np.array([0.0, 0.0, (int(counts.argmax()) + 0.5) * _TABLE_BIN_M - low])
    design = np.column_stack([x, y, np.ones_like(x)])
    residuals = z - design @ coefficients
    for band in _TABLE_BAND_M:
        near = np.abs(residuals) < band
        share = near.mean() * cells_seen / (rows * cols)
        spread = min(x[near].std() / cols, y[near].std() / rows) if near.any() else 0.0
        if share < _TABLE_SHARE or spread < _TABLE_SHARE / 4 * workspace.resolution_m:
            return None
        coefficients = np.linalg.lstsq(design[near], z[near], rcond=None)[0]
        residuals = z - design @ coefficients
    near = np.abs(residuals) < _TABLE_BAND_M[-1]
    return TablePlane(
        tilt_rad=float(np.arctan(np.hypot(coefficients[0], coefficients[1]))),
        offset_m=float(coefficients[2]),
        rms_m=float(np.sqrt(np.mean(residuals[near] ** 2))),
    )
