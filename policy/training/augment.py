"""Random rotations, mirror images, colours and heights of what is learned from, the same before and after a push."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from policy.network import GRASP_ROTATIONS, PUSH_ROTATIONS
from policy.training.replay import Sample, View
from policy.training.shard import GRASP
from robotcell.decision import ROTATIONS

# Error of the table's height that a calibration leaves, in the 0.1 mm of a shard.
_HEIGHT_OFFSET = 10
# Light and white balance: gain of the whole picture, and of each colour.
_BRIGHTNESS = (0.7, 1.3)
_BALANCE = (0.85, 1.15)


def augment(sample: Sample, crop_cells: int, rng: np.random.Generator) -> Sample:
    """A square cut out of a sample, as another table would have shown it. Attempts outside of it are dropped."""
    steps, mirrored = int(rng.integers(ROTATIONS)), bool(rng.integers(2))
    turned = transform(sample, steps, mirrored=mirrored, center=_center(sample, crop_cells, rng), size=crop_cells)
    order = rng.permutation(3)
    table = _color_table(rng)
    offset = int(rng.integers(-_HEIGHT_OFFSET, _HEIGHT_OFFSET + 1))
    return replace(
        turned,
        view=_recolor(turned.view, order, table, offset),
        views_after=tuple(_recolor(view, order, table, offset) for view in turned.views_after),
    )


def transform(sample: Sample, steps: int, *, mirrored: bool, center: tuple[float, float], size: int) -> Sample:
    """Mirror a sample (base y changes its sign), rotate it, and cut a square out of it.

    Cells that come from outside of the map are unknown and empty. Attempts that end outside of the square are
    dropped, and so are pushes whose target does afterwards, as nothing could be said of what follows.

    Args:
        sample: maps (H, W).
        steps: of 22.5 degrees about base z.
        mirrored: whether to mirror.
        center: (row, col) that becomes the middle of the square.
        size: of the square [cells]; a map that is smaller limits it.
    """
    height, width = (min(size, cells) for cells in sample.view.height.shape)
    matrix = _matrix(steps, mirrored, center, (height, width))
    cells = np.stack([sample.col, sample.row, np.ones(len(sample.row))])
    col, row = np.rint(matrix @ cells).astype(np.int16)
    views_after = tuple(_warp(view, matrix, (height, width)) for view in sample.views_after)
    kept = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    for i in np.flatnonzero(kept & (sample.following >= 0)):
        before, after = (
            views[sample.following[i]].labels == sample.target[i] for views in (sample.views_after, views_after)
        )
        kept[i] = after.any() or not before.any()
    planes = np.where(sample.primitive == GRASP, GRASP_ROTATIONS, PUSH_ROTATIONS)
    direction = -sample.rotation.astype(np.int64) if mirrored else sample.rotation.astype(np.int64)
    return Sample(
        view=_warp(sample.view, matrix, (height, width)),
        primitive=sample.primitive[kept],
        row=row[kept],
        col=col[kept],
        rotation=((direction + steps) % planes).astype(np.int8)[kept],
        target=sample.target[kept],
        reward=sample.reward[kept],
        following=sample.following[kept],
        views_after=views_after,
    )


def _center(sample: Sample, crop_cells: int, rng: np.random.Generator) -> tuple[float, float]:
    """(row, col) between the middle of all attempts and one of them: near most, and yet each is seen at times."""
    cells = np.stack([sample.row, sample.col]).astype(np.float64)
    middle = cells.mean(axis=1)
    center = middle + rng.random() * (cells[:, rng.integers(cells.shape[1])] - middle)
    last = np.array(sample.view.height.shape) - 1
    margin = np.minimum(crop_cells - 1, last) / 2
    row, col = center.clip(margin, last - margin).tolist()
    return row, col


def _matrix(steps: int, mirrored: bool, center: tuple[float, float], shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """(2, 3) that maps a cell (col, row, 1) to its new place (col, row)."""
    angle = 2 * math.pi * steps / ROTATIONS
    cosine, sine = math.cos(angle), math.sin(angle)
    linear = np.array([[cosine, -sine], [sine, cosine]])
    if mirrored:
        linear = linear @ np.diag([1.0, -1.0])
    old, new = np.array(center[::-1]), (np.array(shape[::-1]) - 1) / 2
    return np.column_stack([linear, new - linear @ old])


def _warp(view: View, matrix: npt.NDArray[np.float64], shape: tuple[int, int]) -> View:
    warped = (
        cv2.warpAffine(
            plane, matrix, shape[::-1], flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        for plane in (view.height, view.color, view.labels)
    )
    return View(*warped)  # type: ignore[arg-type]


def _color_table(rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """(256, 1, 3): what each value of each channel becomes."""
    gains = rng.uniform(*_BRIGHTNESS) * rng.uniform(*_BALANCE, size=3)
    return (np.arange(256)[:, None, None] * gains).clip(0, 255).astype(np.uint8)


def _recolor(view: View, order: npt.NDArray[np.int64], table: npt.NDArray[np.uint8], offset: int) -> View:
    shifted = (view.height.astype(np.int32) + offset).clip(1, 65535)
    height = np.where(view.height == 0, 0, shifted).astype(np.uint16)
    color = np.asarray(cv2.LUT(np.ascontiguousarray(view.color[:, :, order]), table), np.uint8)
    return View(height, color, view.labels)
