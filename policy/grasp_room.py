"""Antipodal top-down grasps, read off a surface."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.geometry import rg2
from robotcell.motion.grasp import GRASP_DEPTH_M
from robotcell.motion.rotations import GRASP_ROTATIONS, ROTATIONS

if TYPE_CHECKING:
    from policy.shadows import Surface

# What stands this far above the tcp is taken for material that the closed fingers press on: the tips of fingers that
# hold a 50 mm block are 5 mm above it, and 3 mm of noise must not count as a wall.
_PRESS_M = 0.008
# Fingers keep this distance from what they pass, over their own size: calibration, depth noise, half a cell.
_SIDE_MARGIN_M = 0.003
# The open tips must end at least this far above what is beneath them, and are at ease twice as far.
_TIP_MARGIN_M = 0.004
# Measured from the tcp up to the palm (128 mm from the flange) with 10 mm to spare.
_PALM_M = rg2.CLOSED_LENGTH_M - rg2.PALM_M - 0.010
# Slope of a face, and the taper between two faces, at which a grip slips: friction angle of rubber on wood, about
# 35 degrees.
_FRICTION = math.tan(math.radians(35))

# Sampling of the profile between the fingers: step along the closing axis, and offsets across the finger.
_STEP_M = 0.002
_LINES_M = (-0.010, -0.005, 0.0, 0.005, 0.010)
# How far to look across for the object's extent, to hold it near its middle.
_ACROSS_M = 0.050
_ACROSS_STEP_M = 0.004
# At most this many cells are scored in each direction; then the best are refined.
_COARSE_CELLS = 900
_REFINED = 6


@dataclass(frozen=True)
class Grasps:
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


@dataclass(frozen=True)
class Jaw:
    """The gripper as a grasp needs it.

    Attributes:
        opening_m: pre-shaped opening.
        tip_clearance_m: lowest height of the tcp above the table.
    """

    opening_m: float
    tip_clearance_m: float


@dataclass(frozen=True)
class Table:
    """Maps padded so that every sample of a grasp at a cell of the heightmap falls inside.

    Attributes:
        height_m, ceiling_m, top_m: (H', W') likely, greatest and smoothed height; beyond the map the floor, of
            which nothing is known.
        owner: (H', W') label of the object in each cell, 0 for none.
        pad: cells added on each side.
        resolution_m: size of a cell.
    """

    height_m: npt.NDArray[np.float32]
    ceiling_m: npt.NDArray[np.float32]
    top_m: npt.NDArray[np.float32]
    owner: npt.NDArray[np.int32]
    pad: int
    resolution_m: float


def lay_table(surface: Surface, owner: npt.NDArray[np.int32], resolution_m: float, opening_m: float) -> Table:
    """Pad a surface and the labels of its objects for grasps with that opening."""
    reach = math.hypot(max(opening_m / 2 + rg2.FINGER_THICKNESS_M, _ACROSS_M), _ACROSS_M) + 0.01
    pad = math.ceil(reach / resolution_m)
    return Table(
        height_m=np.pad(surface.height_m, pad),
        ceiling_m=np.pad(surface.ceiling_m, pad, constant_values=1.0),
        top_m=np.pad(cv2.medianBlur(surface.height_m, 5), pad),
        owner=np.pad(owner, pad),
        pad=pad,
        resolution_m=resolution_m,
    )


def find_grasps(table: Table, cells: npt.NDArray[np.bool_], jaw: Jaw) -> Grasps:
    """Score grasps centred on `cells` (H, W): a coarse grid of them in all directions, then around the best."""
    step = max(1, math.ceil(math.sqrt(np.count_nonzero(cells) / _COARSE_CELLS)))
    lattice = np.zeros_like(cells)
    lattice[::step, ::step] = True
    rows, cols = np.nonzero(cells & lattice)
    found = _join(
        [_score(table, rows, cols, np.full(len(rows), k, np.intp), jaw) for k in range(GRASP_ROTATIONS)],
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
        _score(table, rows[rotation == k], cols[rotation == k], rotation[rotation == k], jaw)
        for k in range(GRASP_ROTATIONS)
    ]
    return _join([found, *refined])


def finger_reach(opening_m: float) -> float:
    """Distance [m] from the centre of a grasp to the farthest corner that a finger needs room at."""
    along = opening_m / 2 + rg2.FINGER_THICKNESS_M + _SIDE_MARGIN_M
    return math.hypot(along, rg2.FINGER_BREADTH_M / 2 + _SIDE_MARGIN_M)


def finger_room(
    table: Table,
    row: npt.NDArray[np.intp],
    col: npt.NDArray[np.intp],
    rotation: npt.NDArray[np.intp],
    jaw: Jaw,
) -> npt.NDArray[np.float32]:
    """(N,) 0..1: whether the open fingers of grasps at (N,) cells and rotations come down without touching anything."""
    center = (row + table.pad) * table.height_m.shape[1] + col + table.pad
    tip = _tcp(table, center, jaw) + np.float32(rg2.tip_retraction(jaw.opening_m))
    return _finger_room(table, center, tip, rotation, jaw.opening_m)


def _tcp(table: Table, center: npt.NDArray[np.intp], jaw: Jaw) -> npt.NDArray[np.float32]:
    """Height of the tcp above the table at a grasp."""
    return np.asarray(np.maximum(table.top_m.ravel()[center] - GRASP_DEPTH_M, jaw.tip_clearance_m), np.float32)


def _score(
    table: Table,
    rows: npt.NDArray[np.intp],
    cols: npt.NDArray[np.intp],
    rotation: npt.NDArray[np.intp],
    jaw: Jaw,
) -> Grasps:
    """Score grasps that share one direction."""
    stride = table.height_m.shape[1]
    center = (rows + table.pad) * stride + cols + table.pad
    surface = table.top_m.ravel()[center]
    score = np.zeros(len(rows), np.float32)
    grasps = Grasps(rows, cols, rotation, surface, score)
    if not len(rows):
        return grasps
    k = int(rotation[0])
    tcp = _tcp(table, center, jaw)
    tip = tcp + np.float32(rg2.tip_retraction(jaw.opening_m))
    room = _finger_room(table, center, tip, rotation, jaw.opening_m)
    fits = np.flatnonzero(room > 0)
    if len(fits):
        score[fits] = room[fits] * _hold(table, center[fits], tcp[fits], k, jaw.opening_m)
    return grasps


def _finger_room(
    table: Table,
    center: npt.NDArray[np.intp],
    tip: npt.NDArray[np.float32],
    rotation: npt.NDArray[np.intp],
    opening_m: float,
) -> npt.NDArray[np.float32]:
    """0..1: whether both open fingers come down beside the object without touching anything."""
    stride = table.height_m.shape[1]
    bare = _finger_offsets(stride, table.resolution_m, opening_m, 0.0)
    wide = _finger_offsets(stride, table.resolution_m, opening_m, _SIDE_MARGIN_M)
    heights, ceilings = table.height_m.ravel(), table.ceiling_m.ravel()
    free = tip - heights[center[:, None] + bare[rotation]].max(axis=1)
    room = np.zeros(len(center), np.float32)
    fits = np.flatnonzero(free > _TIP_MARGIN_M)
    at = center[fits, None] + wide[rotation[fits]]
    free_around = tip[fits] - heights[at].max(axis=1)
    ease = 0.5 + 0.5 * np.clip(free_around / _TIP_MARGIN_M - 1, 0, 1)
    doubtful = (ceilings[at] > tip[fits, None] - _TIP_MARGIN_M).mean(axis=1)
    room[fits] = ease * (1 - 0.5 * doubtful)
    return room


def _hold(
    table: Table, center: npt.NDArray[np.intp], tcp: npt.NDArray[np.float32], k: int, opening_m: float
) -> npt.NDArray[np.float32]:
    """0..1: how well what is between the fingers can be held."""
    stride = table.height_m.shape[1]
    half = round(opening_m / 2 / _STEP_M)
    lines = len(_LINES_M)
    profile = _profile_offsets(k, stride, table.resolution_m, half)
    at = center[:, None] + profile
    heights = table.height_m.ravel()[at].reshape(-1, lines, 2 * half + 1)
    owners = table.owner.ravel()[at].reshape(heights.shape)
    own = table.owner.ravel()[center][:, None, None]
    low = (tcp + _PRESS_M)[:, None, None]
    top = table.top_m.ravel()[center]
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
    parallel = np.exp(-((taper / (0.7 * _FRICTION)) ** 2)) * np.exp(-((askew / _FRICTION) ** 2))
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
    balanced = _balance(table, center, tcp, k)
    score = fit * centred * contact * parallel * upright * alone * palm * grip * balanced
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
    table: Table, center: npt.NDArray[np.intp], tcp: npt.NDArray[np.float32], k: int
) -> npt.NDArray[np.float32]:
    """0..1: how near the fingers are to the middle of the object's extent across the closing axis."""
    half = round(_ACROSS_M / _ACROSS_STEP_M)
    at = center[:, None] + _across_offsets(k, table.height_m.shape[1], table.resolution_m, half)
    material = table.height_m.ravel()[at] > (tcp + _PRESS_M)[:, None]
    material &= table.owner.ravel()[at] == table.owner.ravel()[center][:, None]
    up, down = _extents(material, half)
    off_center = np.abs(up - down) * _ACROSS_STEP_M / 2
    return np.asarray(np.exp(-((off_center / 0.022) ** 2)), np.float32)


@lru_cache(maxsize=64)
def _finger_offsets(stride: int, resolution_m: float, opening_m: float, margin_m: float) -> npt.NDArray[np.intp]:
    """(K, N) flat offsets of the cells under both fingers, from the centre of the grasp, in every direction."""
    along = _spaced(rg2.FINGER_THICKNESS_M / 2 + margin_m, resolution_m) + opening_m / 2 + rg2.FINGER_THICKNESS_M / 2
    across = _spaced(rg2.FINGER_BREADTH_M / 2 + margin_m, resolution_m)
    both = np.concatenate([along, -along])
    return np.stack([_flat(k, both, across, stride, resolution_m) for k in range(GRASP_ROTATIONS)])


@lru_cache(maxsize=64)
def _profile_offsets(k: int, stride: int, resolution_m: float, half: int) -> npt.NDArray[np.intp]:
    """Flat offsets of the samples between the fingers, line by line."""
    return _flat(k, np.arange(-half, half + 1) * _STEP_M, np.array(_LINES_M), stride, resolution_m)


@lru_cache(maxsize=64)
def _across_offsets(k: int, stride: int, resolution_m: float, half: int) -> npt.NDArray[np.intp]:
    """Flat offsets of the samples across the closing axis."""
    return _flat(k, np.zeros(1), np.arange(-half, half + 1) * _ACROSS_STEP_M, stride, resolution_m)


def _flat(
    k: int, along: npt.NDArray[np.floating], across: npt.NDArray[np.floating], stride: int, resolution_m: float
) -> npt.NDArray[np.intp]:
    """Flat offsets of a grid along and across direction k, the line across varying slowest."""
    theta = 2 * math.pi * k / ROTATIONS
    u, v = np.meshgrid(along, across)
    cols = np.rint((u * math.cos(theta) - v * math.sin(theta)) / resolution_m)
    rows = np.rint((u * math.sin(theta) + v * math.cos(theta)) / resolution_m)
    return np.asarray(rows * stride + cols, np.intp).ravel()


def _spaced(half_m: float, resolution_m: float) -> npt.NDArray[np.floating]:
    """Offsets from -half to half, a cell and a half apart at most."""
    return np.linspace(-half_m, half_m, max(2, math.ceil(2 * half_m / (1.5 * resolution_m)) + 1))


def _join(parts: list[Grasps]) -> Grasps:
    return Grasps(
        row=np.concatenate([p.row for p in parts]),
        col=np.concatenate([p.col for p in parts]),
        rotation=np.concatenate([p.rotation for p in parts]),
        surface_m=np.concatenate([p.surface_m for p in parts]),
        score=np.concatenate([p.score for p in parts]),
    )
