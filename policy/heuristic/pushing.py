"""Straight pushes that free the border of an object, found by moving the objects' outlines as the push would."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from policy.shadows import cell_centers
from robotcell.geometry import rg2
from robotcell.motion.rotations import ROTATIONS

if TYPE_CHECKING:
    from policy.shadows import Surface
    from robotcell.config import Workspace
    from robotcell.geometry.transforms import Array

# Outlines are moved on a grid of this size: a push lands within some millimetres at best.
_GRID_M = 0.004
# The closed fingers along the push and across it, half of each.
_HALF_LENGTH_M = rg2.FINGER_THICKNESS_M
_HALF_WIDTH_M = rg2.FINGER_BREADTH_M / 2
# Room that the closed fingers need to come down: their size, with 4 mm for calibration and noise on each side.
_FREE_RADIUS_M = 0.015
_FREE_HEIGHT_M = 0.008
# A shadow lower than this hides no block (the lowest is 25 mm high).
_HIDDEN_HEIGHT_M = 0.020
# Starts are tried this far from the object's outline, and this far to the side of its middle.
_STANDOFF_M = (0.008, 0.016, 0.026, 0.040, 0.056)
_ASIDE_M = (-0.024, -0.016, -0.008, 0.0, 0.008, 0.016, 0.024)
# Border of a goal: paper, ten dilations of 2 mm.
_BORDER_M = 0.020
# Worth of a push that frees no border, yet moves goal and neighbours apart: what is last tried in a heap.
_STIR = 0.05
# Objects are considered for a push when they are this near to the goal.
_NEIGHBOUR_M = 0.030
# The middle of a pushed object should stay this far inside the workspace.
_EDGE_M = 0.03
# A push this far beside the middle of what it meets turns it more than it moves it.
_TURNING_M = 0.03
# Each further object that moves makes the outcome less certain by this factor.
_COMPANY = 0.85
# Worth of a push that takes another object out of the workspace.
_LOSS = 0.3
# An object that is pushed pushes the next, this many times over.
_CHAIN = 3
# Without a goal, pushes are sought for so many of the largest objects.
_TARGETS = 4


@dataclass(frozen=True)
class Pushes:
    """Scored pushes.

    Attributes:
        row, col, rotation: (N,) cell of the heightmap where the closed fingers come down, and direction, 0..15.
        surface_m: (N,) height of the object that is pushed.
        score: (N,) 0..1: gain in free border of the goal, less what makes the outcome doubtful.
    """

    row: npt.NDArray[np.intp]
    col: npt.NDArray[np.intp]
    rotation: npt.NDArray[np.intp]
    surface_m: npt.NDArray[np.float32]
    score: npt.NDArray[np.float32]


@dataclass(frozen=True)
class _Scene:
    """The objects on a coarse grid.

    Attributes:
        labels: (H, W) of the heightmap, 0 = none; object i has the label i + 1.
        workspace: where its cells are.
        xy: (M, 2) positions [m] of the object cells of the coarse grid.
        owner: (M,) which object each belongs to.
        centroid: (N, 2) of the objects [m].
        radius: (N,) distance of their outermost cells from that [m].
        top_m: (N,) their heights.
    """

    labels: npt.NDArray[np.int32]
    workspace: Workspace
    xy: Array
    owner: npt.NDArray[np.intp]
    centroid: Array
    radius: Array
    top_m: Array

    @property
    def count(self) -> int:
        return len(self.centroid)


def find_pushes(
    surface: Surface, labels: npt.NDArray[np.int32], goal: int | None, workspace: Workspace, push_m: float
) -> Pushes:
    """Score pushes of `push_m` that free the goal, or any of the largest objects where there is no goal.

    Each object that the closed fingers meet moves with them, and so does what it meets in turn; nothing turns.
    The gain is the fall in the share of the goal's border that other objects occupy (paper, stage II).
    """
    scene = _scene(surface, labels, workspace)
    sizes = np.bincount(scene.owner, minlength=scene.count)
    largest = [int(i) for i in np.argsort(-sizes, kind="stable")[:_TARGETS] if sizes[i]]
    targets = largest if goal is None else [goal - 1]
    free = _free_to_descend(surface, workspace)
    found = [_no_pushes()]
    for k in range(ROTATIONS):
        theta = 2 * math.pi * k / ROTATIONS
        strips = _strips(scene, np.array([math.cos(theta), math.sin(theta)]))
        found += [_pushes_along(k, target, scene, strips, free, push_m) for target in targets]
    return Pushes(
        row=np.concatenate([p.row for p in found]),
        col=np.concatenate([p.col for p in found]),
        rotation=np.concatenate([p.rotation for p in found]),
        surface_m=np.concatenate([p.surface_m for p in found]),
        score=np.concatenate([p.score for p in found]),
    )


def _no_pushes() -> Pushes:
    none = np.zeros(0, np.intp)
    return Pushes(none, none, none, np.zeros(0, np.float32), np.zeros(0, np.float32))


def _scene(surface: Surface, labels: npt.NDArray[np.int32], workspace: Workspace) -> _Scene:
    step = max(1, round(_GRID_M / workspace.resolution_m))
    rows, cols = np.nonzero(labels[::step, ::step])
    x, y = cell_centers(workspace, rows * step, cols * step)
    owner = labels[::step, ::step][rows, cols].astype(np.intp) - 1
    count = int(labels.max())
    heights = surface.height_m[::step, ::step][rows, cols]
    cells = np.maximum(np.bincount(owner, minlength=count), 1)
    xy = np.column_stack([x, y])
    centroid = np.column_stack([np.bincount(owner, v, count) / cells for v in (x, y)])
    radius = np.zeros(count)
    np.maximum.at(radius, owner, np.linalg.norm(xy - centroid[owner], axis=1))
    return _Scene(
        labels=labels,
        workspace=workspace,
        xy=xy,
        owner=owner,
        centroid=centroid,
        radius=radius,
        top_m=np.array([np.percentile(heights[owner == i], 90) if (owner == i).any() else 0.0 for i in range(count)]),
    )


def _free_to_descend(surface: Surface, workspace: Workspace) -> npt.NDArray[np.bool_]:
    """(H, W) cells at which the closed fingers come down on nothing that is seen and nothing tall that is not."""
    size = 2 * math.ceil(_FREE_RADIUS_M / workspace.resolution_m) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    occupied = (surface.height_m > _FREE_HEIGHT_M) | (surface.ceiling_m > _HIDDEN_HEIGHT_M)
    return np.asarray(cv2.dilate(occupied.astype(np.uint8), disc) == 0)


@dataclass(frozen=True)
class _Strips:
    """The objects cut into strips along a direction.

    Attributes:
        along, aside: (2,) unit vectors of the direction and of its normal.
        back, front: (N, strips) where each object begins and ends in each strip [m]; infinite where it is not.
        swept: (N, strips) where each object begins in what fingers that run in that strip sweep.
        first: number of the first strip; strip b covers (b - 0.5 .. b + 0.5) grid steps aside.
        gap: (N, N) how far i can move before it meets j [m]; infinite where it never does.
    """

    along: Array
    aside: Array
    back: Array
    front: Array
    swept: Array
    first: int
    gap: Array


def _strips(scene: _Scene, along: Array) -> _Strips:
    aside = np.array([-along[1], along[0]])
    a = scene.xy @ along
    b = np.rint(scene.xy @ aside / _GRID_M).astype(np.intp)
    first = int(b.min())
    back = np.full((scene.count, int(b.max()) - first + 1), np.inf)
    front = np.full_like(back, -np.inf)
    np.minimum.at(back, (scene.owner, b - first), a)
    np.maximum.at(front, (scene.owner, b - first), a)
    # Outlines touch or overlap by noise: who stands further along is ahead.
    present = np.isfinite(back)
    middle = np.where(present, np.where(present, back, 0) + np.where(present, front, 0), np.nan)
    ahead = middle[None] > middle[:, None]  # False where either is not in the strip
    gap = np.where(ahead, np.maximum(back[None] - front[:, None], 0), np.inf).min(axis=2)
    half = int(_HALF_WIDTH_M / _GRID_M)
    wide = np.pad(back, ((0, 0), (half, half)), constant_values=np.inf)
    swept = np.min([wide[:, i : i + back.shape[1]] for i in range(2 * half + 1)], axis=0)
    return _Strips(along, aside, back, front, swept, first, gap)


def _pushes_along(
    k: int, target: int, scene: _Scene, strips: _Strips, free: npt.NDArray[np.bool_], push_m: float
) -> Pushes:
    """Scored pushes in one direction for one object."""
    border = _border(scene, target)
    neighbours = [i for i in _labels_near(scene, target) if i != target]
    starts = _starts([target, *neighbours], scene, strips, free)
    if not len(starts) or not len(border):
        return _no_pushes()
    moved, first_met = _play(starts, strips, push_m)
    shift = moved[:, [target]] - moved
    apart = np.abs(shift[:, neighbours]).max(axis=1, initial=0)
    useful = np.flatnonzero(apart > _GRID_M)
    if not len(useful):
        return _no_pushes()
    starts, moved, first_met, shift = starts[useful], moved[useful], first_met[useful], shift[useful]
    before = _occupied(border, scene, target, np.zeros((1, scene.count)), strips.along)
    after = _occupied(border, scene, target, shift, strips.along)
    gain = np.clip(before - after, 0, 1) + _STIR * np.minimum(apart[useful] / _BORDER_M, 1)
    score = np.minimum(gain, 1) * _certainty(starts, moved, first_met, target, scene, strips)
    x, y = starts.T
    row = np.floor((y - scene.workspace.y[0]) / scene.workspace.resolution_m).astype(np.intp)
    col = np.floor((x - scene.workspace.x[0]) / scene.workspace.resolution_m).astype(np.intp)
    return Pushes(
        row,
        col,
        np.full(len(row), k, np.intp),
        scene.top_m[first_met].astype(np.float32),
        score.astype(np.float32),
    )


def _border(scene: _Scene, target: int) -> Array:
    """(B, 2) positions of the cells around an object [m]."""
    resolution = scene.workspace.resolution_m
    size = 2 * round(_BORDER_M / resolution) + 1
    mask = (scene.labels == target + 1).astype(np.uint8)
    ring = (cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0) & (mask == 0)
    step = max(1, round(_GRID_M / resolution))
    rows, cols = np.nonzero(ring[::step, ::step])
    return np.column_stack(cell_centers(scene.workspace, rows * step, cols * step))


def _labels_near(scene: _Scene, target: int) -> list[int]:
    """Objects that stand near an object."""
    size = 2 * round(_NEIGHBOUR_M / scene.workspace.resolution_m) + 1
    mask = (scene.labels == target + 1).astype(np.uint8)
    near = np.unique(scene.labels[cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0])
    present = set(np.unique(scene.owner).tolist())
    return [int(label) - 1 for label in near if label > 0 and int(label) - 1 in present]


def _starts(movers: list[int], scene: _Scene, strips: _Strips, free: npt.NDArray[np.bool_]) -> Array:
    """(S, 2) places behind the objects where the closed fingers can come down [m]."""
    mover = np.repeat(np.array(movers, np.intp), len(_ASIDE_M))
    b = scene.centroid[mover] @ strips.aside + np.tile(_ASIDE_M, len(movers))
    strip = np.rint(b / _GRID_M).astype(np.intp) - strips.first
    on = (strip >= 0) & (strip < strips.back.shape[1])
    on &= np.isfinite(strips.back[mover, np.where(on, strip, 0)])
    mover, b, strip = mover[on], b[on], strip[on]
    a = strips.swept[mover, strip] - _HALF_LENGTH_M - np.array(_STANDOFF_M)[:, None]
    xy = a.reshape(-1, 1) * strips.along + np.tile(b, len(_STANDOFF_M))[:, None] * strips.aside
    workspace = scene.workspace
    row = np.floor((xy[:, 1] - workspace.y[0]) / workspace.resolution_m).astype(np.intp)
    col = np.floor((xy[:, 0] - workspace.x[0]) / workspace.resolution_m).astype(np.intp)
    inside = (row >= 0) & (row < free.shape[0]) & (col >= 0) & (col < free.shape[1])
    return np.asarray(xy[inside][free[row[inside], col[inside]]], np.float64)


def _play(starts: Array, strips: _Strips, push_m: float) -> tuple[Array, npt.NDArray[np.intp]]:
    """How far each object moves (S, N) [m], and which one each push meets first (S,)."""
    a, b = starts @ strips.along, starts @ strips.aside
    strip = np.rint(b / _GRID_M).astype(np.intp) - strips.first
    begin = strips.swept[:, strip].T
    ahead = np.where(begin > a[:, None], begin, np.inf)
    way = np.maximum(ahead - a[:, None] - _HALF_LENGTH_M, 0)
    moved = np.clip(push_m - way, 0, None)
    for _ in range(_CHAIN):
        moved = np.maximum(moved, (moved[:, :, None] - strips.gap).max(axis=1))
    return moved, way.argmin(axis=1)


def _occupied(border: Array, scene: _Scene, target: int, shift: Array, along: Array) -> Array:
    """(S,) share of the target's border that others occupy once each has moved by -shift (S, N) against it."""
    workspace = scene.workspace
    taken = np.zeros((len(shift), len(border)), np.bool_)
    reach = np.linalg.norm(border - scene.centroid[target], axis=1).max() + np.abs(shift).max(axis=0)
    near = np.linalg.norm(scene.centroid - scene.centroid[target], axis=1) < reach + scene.radius
    near[target] = False
    for other in np.flatnonzero(near):
        # Most pushes leave most objects where they are: look each shift up once.
        steps, which = np.unique(np.rint(shift[:, other] / _GRID_M), return_inverse=True)
        xy = border + (steps * _GRID_M)[:, None, None] * along
        row = np.floor((xy[..., 1] - workspace.y[0]) / workspace.resolution_m).astype(np.intp)
        col = np.floor((xy[..., 0] - workspace.x[0]) / workspace.resolution_m).astype(np.intp)
        inside = (row >= 0) & (row < scene.labels.shape[0]) & (col >= 0) & (col < scene.labels.shape[1])
        hit = scene.labels[np.where(inside, row, 0), np.where(inside, col, 0)] == other + 1
        taken |= (inside & hit)[which]
    return np.asarray(taken.mean(axis=1), np.float64)


def _certainty(
    starts: Array,
    moved: Array,
    first_met: npt.NDArray[np.intp],
    target: int,
    scene: _Scene,
    strips: _Strips,
) -> Array:
    """(S,) 0..1: how likely the push ends as it was played, with everything still inside the workspace."""
    offset = (scene.centroid[first_met] - starts) @ strips.aside
    turning = np.exp(-((offset / _TURNING_M) ** 2))
    company = _COMPANY ** np.maximum((moved > _GRID_M).sum(axis=1) - 1, 0)
    end = scene.centroid + moved[..., None] * strips.along
    workspace = scene.workspace
    inside = (end[..., 0] > workspace.x[0] + _EDGE_M) & (end[..., 0] < workspace.x[1] - _EDGE_M)
    inside &= (end[..., 1] > workspace.y[0] + _EDGE_M) & (end[..., 1] < workspace.y[1] - _EDGE_M)
    lost = ~inside & (moved > _GRID_M)
    kept = np.where(lost[:, target], 0.0, np.where(lost.any(axis=1), _LOSS, 1.0))
    return np.asarray(turning * company * kept, np.float64)
