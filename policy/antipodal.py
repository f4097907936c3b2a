"""Antipodal grasps from above, read off the heights: two faces that the fingers can hold, and room to come down."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from policy.finger_clearance import (
    SAMPLED_M,
    OpenGripper,
    PaddedMaps,
    finger_clearance,
    grid_offsets,
    tcp_height_m,
)
from robotcell.geometry import rg2
from robotcell.motion.rotations import GRASP_ROTATIONS

# What stands this far above the tcp is taken for material that the closed fingers press on: the tips of fingers that
# hold a 50 mm block are 5 mm above it, and 3 mm of noise must not count as a wall.
_PRESS_M = 0.008
# Measured from the tcp up to the palm (128 mm from the flange) with 10 mm to spare.
_PALM_M = rg2.CLOSED_LENGTH_M - rg2.PALM_M - 0.010
# Slope of a face, and the taper between two faces, at which a grip slips: friction angle of rubber on wood, about
# 35 degrees.
_FRICTION = math.tan(math.radians(35))

# Sampling of the profile between the fingers: step along the closing axis, and offsets across the finger.
_STEP_M = 0.002
_LINES_M = (-0.010, -0.005, 0.0, 0.005, 0.010)
# Step across it, where the object's extent is looked at to hold it near its middle.
_ACROSS_STEP_M = 0.004
# At most this many cells are scored in each direction; then the best are refined.
_COARSE_CELLS = 900
_REFINED = 6


@dataclass(frozen=True)
class AntipodalGrasps:
    """Scored grasps.

    Attributes:
        row, col, rotation: (N,) centre cell and direction, 0..7.
        surface_m: (N,) height of the surface at the centre.
        score: (N,) 0..1; 0 = a finger does not fit, or there is nothing to hold.
    """

    row: npt.NDArray[np.intp]
    col: npt.NDArray[np.intp]
    rotation: npt.NDArray[np.intp]
    surface_m: npt.NDArray[np.float32]
    score: npt.NDArray[np.float32]


def antipodal_grasps(maps: PaddedMaps, cells: npt.NDArray[np.bool_], gripper: OpenGripper) -> AntipodalGrasps:
    """Score grasps centred on `cells` (H, W): a coarse grid of them in all directions, then around the best."""
    step = max(1, math.ceil(math.sqrt(np.count_nonzero(cells) / _COARSE_CELLS)))
    lattice = np.zeros_like(cells)
    lattice[::step, ::step] = True
    rows, cols = np.nonzero(cells & lattice)
    found = _join(
        [_score(maps, rows, cols, np.full(len(rows), k, np.intp), gripper) for k in range(GRASP_ROTATIONS)],
    )
    if step == 1:
        return found
    best = np.argsort(-found.score, kind="stable")[:_REFINED]
    offsets = np.mgrid[-step : step + 1, -step : step + 1].reshape(2, -1)
    rows = (found.row[best, None] + offsets[0]).ravel()
    cols = (found.col[best, None] + offsets[1]).ravel()
    rotation = np.repeat(found.rotation[best], offsets.shape[1])
    inside = (rows >= 0) & (rows < cells.shape[0]) & (cols >= 0) & (cols < cells.shape[1])
    rows, cols, rotation = rows[inside], cols[inside], rotation[inside]
    on = cells[rows, cols]
    rows, cols, rotation = rows[on], cols[on], rotation[on]
    refined = [
        _score(maps, rows[rotation == k], cols[rotation == k], rotation[rotation == k], gripper)
        for k in range(GRASP_ROTATIONS)
    ]
    return _join([found, *refined])


def _score(
    maps: PaddedMaps,
    rows: npt.NDArray[np.intp],
    cols: npt.NDArray[np.intp],
    rotation: npt.NDArray[np.intp],
    gripper: OpenGripper,
) -> AntipodalGrasps:
    """Score grasps that share one direction."""
    center = maps.flat_index(rows, cols)
    score = np.zeros(len(rows), np.float32)
    if len(rows):
        clearance = finger_clearance(maps, rows, cols, rotation, gripper)
        fits = np.flatnonzero(clearance > 0)
        if len(fits):
            tcp = tcp_height_m(maps, rows[fits], cols[fits], gripper)
            score[fits] = clearance[fits] * _hold(maps, center[fits], tcp, int(rotation[0]), gripper.opening_m)
    return AntipodalGrasps(rows, cols, rotation, maps.top_m.ravel()[center], score)


def _hold(
    maps: PaddedMaps, center: npt.NDArray[np.intp], tcp: npt.NDArray[np.float32], k: int, opening_m: float
) -> npt.NDArray[np.float32]:
    """0..1: how well what is between the fingers can be held."""
    stride = maps.height_m.shape[1]
    half = round(opening_m / 2 / _STEP_M)
    lines = len(_LINES_M)
    profile = _profile_offsets(k, stride, maps.resolution_m, half)
    at = center[:, None] + profile
    heights = maps.height_m.ravel()[at].reshape(-1, lines, 2 * half + 1)
    owners = maps.owner.ravel()[at].reshape(heights.shape)
    own = maps.owner.ravel()[center][:, None, None]
    low = (tcp + _PRESS_M)[:, None, None]
    top = maps.top_m.ravel()[center]
    high = (tcp + _PRESS_M + 0.6 * (top - tcp - _PRESS_M))[:, None, None]

    material = heights > low
    right, left = _extents(material, half)
    right_high, left_high = _extents(heights > high, half)
    held = right + left > 0
    contact_right = np.where(held, right, 0).max(axis=1)
    contact_left = np.where(held, left, 0).max(axis=1)
    width = (contact_right + contact_left - 1) * _STEP_M  # both count the centre

    # Both fingers must close on something: a run that reaches a finger, or is next to none, is no grip.
    reaches = np.maximum(contact_left, contact_right) * _STEP_M
    fit = np.clip((opening_m - width - 0.004) / 0.008, 0, 1) * (reaches < opening_m / 2 - _STEP_M)
    fit *= np.clip((width - 0.006) / 0.006, 0, 1)
    # The finger that arrives first pushes the object to the other one.
    off_center = np.abs(contact_right - contact_left) * _STEP_M / 2
    centred = np.exp(-((off_center / 0.010) ** 2))
    # Breadth of the pads that touches: lines that end close to the outermost.
    slack = 0.005 / _STEP_M
    touching = np.minimum(
        (held & (right >= contact_right[:, None] - slack)).sum(axis=1),
        (held & (left >= contact_left[:, None] - slack)).sum(axis=1),
    )
    contact = np.clip(touching / (0.8 * lines), 0, 1)
    # Faces that converge across the finger squeeze the object out; those that only stand askew turn it.
    across = np.array(_LINES_M, np.float32)
    weight = held.astype(np.float32)
    slope_right, slope_left = (_slope(side * np.float32(_STEP_M), across, weight) for side in (right, left))
    taper = np.abs(slope_right + slope_left) / 2
    askew = np.abs(slope_right - slope_left) / 2
    facing = np.exp(-((taper / (0.7 * _FRICTION)) ** 2)) * np.exp(-((askew / _FRICTION) ** 2))
    # Faces that lean: the run is narrower further up.
    rise = np.maximum((high - low)[:, 0, 0], 0.004)
    lean = np.maximum(
        np.median(np.where(held, right - right_high, 0), axis=1), np.median(np.where(held, left - left_high, 0), axis=1)
    ) * (_STEP_M / rise)
    upright = np.exp(-((lean / (0.8 * _FRICTION)) ** 2))
    # Anything else in the way of the fingers.
    foreign = (material & (owners != own)).sum(axis=(1, 2)) / np.maximum(material.sum(axis=(1, 2)), 1)
    alone = np.clip(1 - foreign / 0.20, 0, 1)
    palm = heights.max(axis=(1, 2)) - tcp < _PALM_M
    # Enough of the face above the tips.
    grip = np.clip((top - tcp - _PRESS_M) / 0.012, 0, 1)
    balanced = _balance(maps, center, tcp, k)
    score = fit * centred * contact * facing * upright * alone * palm * grip * balanced
    return np.asarray(score, np.float32)


def _extents(material: npt.NDArray[np.bool_], half: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Samples of unbroken material from the centre to the right and to the left, (N, lines)."""
    right = np.logical_and.accumulate(material[..., half:], axis=-1).sum(axis=-1)
    left = np.logical_and.accumulate(material[..., half::-1], axis=-1).sum(axis=-1)
    return right, left


def _slope(
    extents: npt.NDArray[np.float32], across: npt.NDArray[np.float32], weight: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Slope of (N, lines) extents over the offset of the lines, by least squares over the lines that count."""
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1)
    x = across - (weight * across).sum(axis=1, keepdims=True) / total
    y = extents - (weight * extents).sum(axis=1, keepdims=True) / total
    return np.asarray((weight * x * y).sum(axis=1) / np.maximum((weight * x * x).sum(axis=1), 1e-6), np.float32)


def _balance(
    maps: PaddedMaps, center: npt.NDArray[np.intp], tcp: npt.NDArray[np.float32], k: int
) -> npt.NDArray[np.float32]:
    """0..1: how near the fingers are to the middle of the object's extent across the closing axis."""
    half = round(SAMPLED_M / _ACROSS_STEP_M)
    at = center[:, None] + _across_offsets(k, maps.height_m.shape[1], maps.resolution_m, half)
    material = maps.height_m.ravel()[at] > (tcp + _PRESS_M)[:, None]
    material &= maps.owner.ravel()[at] == maps.owner.ravel()[center][:, None]
    up, down = _extents(material, half)
    off_center = np.abs(up - down) * _ACROSS_STEP_M / 2
    return np.asarray(np.exp(-((off_center / 0.022) ** 2)), np.float32)


@lru_cache(maxsize=64)
def _profile_offsets(k: int, stride: int, resolution_m: float, half: int) -> npt.NDArray[np.intp]:
    """Flat offsets of the samples between the fingers, line by line."""
    return grid_offsets(k, np.arange(-half, half + 1) * _STEP_M, np.array(_LINES_M), stride, resolution_m)


@lru_cache(maxsize=64)
def _across_offsets(k: int, stride: int, resolution_m: float, half: int) -> npt.NDArray[np.intp]:
    """Flat offsets of the samples across the closing axis."""
    return grid_offsets(k, np.zeros(1), np.arange(-half, half + 1) * _ACROSS_STEP_M, stride, resolution_m)


def _join(parts: list[AntipodalGrasps]) -> AntipodalGrasps:
    return AntipodalGrasps(
        row=np.concatenate([p.row for p in parts]),
        col=np.concatenate([p.col for p in parts]),
        rotation=np.concatenate([p.rotation for p in parts]),
        surface_m=np.concatenate([p.surface_m for p in parts]),
        score=np.concatenate([p.score for p in parts]),
    )
