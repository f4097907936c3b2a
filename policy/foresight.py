"""What a push would do, played ahead on the plane of the table: objects as prisms that slide, turn and touch.

The physics is Chipmunk's (pymunk), seen from above, with the table's friction added as Coulomb's. It knows nothing of
toppling and stacks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt
import pymunk

from policy.border import border_cells, stands
from robotcell import linkage
from robotcell.decision import ROTATIONS

if TYPE_CHECKING:
    from policy.push_line import PushLine
    from robotcell.geometry import Array

_GRAVITY_M_S2 = 9.81
# Wood on a mat, on wood and on rubber; about the middle of what training draws.
_TABLE_FRICTION = 0.6
_OBJECT_FRICTION = 0.6
_FINGER_FRICTION = 0.8
# Share of the radius at which friction acts against turning: two thirds for a disc that only turns, less for what
# slides as well. Set by comparing plays with the twin.
_LEVER = 0.3
# Twice as fast as the arm: friction of the table makes the outcome depend on the way alone.
_SPEED_M_S = 0.16
_STEP_S = 1 / 240
# Outlines overlap by noise: so much is left alone, and a tenth of what is more goes in every step.
_OVERLAP_M = 0.0006
_LEFT_OVERLAP = 0.9**240
# An object of fewer cells is noise.
_LEAST_CELLS = 12
# What is pushed nearer to the rim of the map than this may leave it, or leaves no room for a finger.
_RIM_M = 0.03
# The fingers pass over what is lower than their tips, with so much to spare.
_CLEAR_M = 0.002


@dataclass(frozen=True)
class _Prism:
    """An object: `outline` (N, 2) convex, x and y in metres from the map's corner, and its height."""

    outline: Array
    height_m: float

    @cached_property
    def area(self) -> float:
        return float(cv2.contourArea(self.outline.astype(np.float32)))

    @cached_property
    def radius(self) -> float:
        return math.sqrt(self.area / math.pi)

    @cached_property
    def center(self) -> Array:
        return np.asarray(self.outline.mean(axis=0))


@dataclass(frozen=True)
class Played:
    """What came of a push.

    Attributes:
        moves: (2, 3) by label of each object that moved: the map's x and y [m] before to those after.
        lost: whether one of them came so near to the rim of the workspace that it may leave it.
    """

    moves: dict[int, Array]
    lost: bool


class Foresight:
    """The objects of one view.

    Args:
        labels: (H, W) the object in each cell, 0 for none.
        height_m: (H, W) with closed gaps, NaN where nothing was seen.
        resolution_m: size of a cell.
    """

    def __init__(self, labels: npt.NDArray[np.integer], height_m: npt.NDArray[np.float32], resolution_m: float) -> None:
        self._labels = labels
        self._height_m = np.nan_to_num(height_m, nan=0.0)
        self._resolution_m = resolution_m
        self._prisms = {int(i): prism for i in np.unique(labels) if i and (prism := self._prism(int(i))) is not None}
        self._borders: dict[int, tuple[Array, float]] = {}
        self._standing = stands(self._height_m)

    def play(self, line: PushLine, rotation: int) -> Played:
        """Move the closed fingers along a push."""
        resolution = self._resolution_m
        theta = 2 * math.pi * rotation / ROTATIONS
        along = np.array([math.cos(theta), math.sin(theta)])
        length = (len(line.cells) - 1) * resolution
        start = (np.array([line.col, line.row]) + 0.5) * resolution
        space = pymunk.Space()
        space.collision_slop, space.collision_bias = _OVERLAP_M, _LEFT_OVERLAP
        bodies = {}
        for label, prism in self._prisms.items():
            ahead = (prism.center - start) @ along
            aside = abs((prism.center - start) @ (-along[1], along[0]))
            reached = -0.1 < ahead < 2 * length + 0.1 and aside < length
            # The paper pushes at half of the height of what is met.
            if reached and prism.height_m > line.top_m / 2 + _CLEAR_M:
                bodies[label] = _add(space, prism)
        fingers = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        fingers.position, fingers.angle = (float(start[0]), float(start[1])), theta
        fingers.velocity = (float(_SPEED_M_S * along[0]), float(_SPEED_M_S * along[1]))
        box = pymunk.Poly.create_box(fingers, (2 * linkage.FINGER_THICKNESS_M, linkage.FINGER_BREADTH_M))
        box.friction = _FINGER_FRICTION
        space.add(fingers, box)
        for _ in range(round(length / _SPEED_M_S / _STEP_S)):
            space.step(_STEP_S)
        return self._outcome(bodies)

    def freed(self, label: int, played: Played) -> float:
        """How much of an object's border a push frees: the fall in the share that others stand on (paper, stage II)."""
        border, occupied = self._border(label)
        if not len(border):
            return 0.0
        return occupied - float(self._occupied(label, border, played.moves).mean())

    def _prism(self, label: int) -> _Prism | None:
        mask = (self._labels == label).astype(np.uint8)
        if np.count_nonzero(mask) < _LEAST_CELLS:
            return None
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        hull = cv2.convexHull(max(contours, key=cv2.contourArea))[:, 0].astype(np.float64)
        prism = _Prism((hull + 0.5) * self._resolution_m, float(np.percentile(self._height_m[mask > 0], 90)))
        return prism if prism.area > 0 else None

    def _outcome(self, bodies: dict[int, pymunk.Body]) -> Played:
        moves, lost = {}, False
        rows, cols = self._labels.shape
        size = np.array([cols, rows]) * self._resolution_m
        for label, body in bodies.items():
            before = self._prisms[label].center
            cos, sin = math.cos(body.angle), math.sin(body.angle)
            turn = np.array([[cos, -sin], [sin, cos]])
            # The body's frame was at the middle of the outline.
            after = np.array([body.position.x, body.position.y])
            if np.abs(after - before).max() > self._resolution_m / 4 or abs(sin) > 0.02:
                move = moves[label] = np.column_stack([turn, after - turn @ before])
                outline = self._prisms[label].outline
                margin_before, margin = (
                    min(xy.min(), (size - xy).min()) for xy in (outline, outline @ move[:, :2].T + move[:, 2])
                )
                lost = lost or bool(margin < min(_RIM_M, margin_before))
        return Played(moves, lost)

    def _border(self, label: int) -> tuple[Array, float]:
        """(N, 2) x and y [m] of the cells around an object, and the share of them that others stand on."""
        if label not in self._borders:
            border = np.asarray((border_cells(self._labels == label)[:, ::-1] + 0.5) * self._resolution_m, np.float64)
            occupied = float(self._occupied(label, border, {}).mean()) if len(border) else 0.0
            self._borders[label] = border, occupied
        return self._borders[label]

    def _occupied(self, label: int, border: Array, moves: dict[int, Array]) -> npt.NDArray[np.bool_]:
        """(N,) whether something else stands on the border, which goes with its object."""
        if label in moves:
            border = border @ moves[label][:, :2].T + moves[label][:, 2]
        owner, standing = self._at(border)
        taken = standing & ~np.isin(owner, [label, *moves])
        for other, move in moves.items():
            if other != label:
                owner, standing = self._at((border - move[:, 2]) @ move[:, :2])
                taken |= standing & (owner == other)
        return np.asarray(taken)

    def _at(self, xy: Array) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.bool_]]:
        """Which object is at (N, 2) places, and whether anything stands there."""
        col, row = np.floor(xy / self._resolution_m).astype(np.intp).T
        rows, cols = self._labels.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        row, col = np.where(inside, row, 0), np.where(inside, col, 0)
        return np.where(inside, self._labels[row, col], 0), inside & self._standing[row, col]


def _add(space: pymunk.Space, prism: _Prism) -> pymunk.Body:
    corners = [(float(x), float(y)) for x, y in prism.outline - prism.center]
    # The density is the same for all, and its value without meaning.
    mass = prism.area * prism.height_m
    body = pymunk.Body(mass, pymunk.moment_for_poly(mass, corners))
    shape = pymunk.Poly(body, corners)
    shape.friction = _OBJECT_FRICTION
    body.position = (float(prism.center[0]), float(prism.center[1]))
    # Coulomb's friction of the table: joints that may slip, and pull back to no place.
    weight = _TABLE_FRICTION * _GRAVITY_M_S2 * mass
    drag = pymunk.PivotJoint(space.static_body, body, (0, 0), (0, 0))
    drag.max_bias, drag.max_force = 0.0, weight
    twist = pymunk.GearJoint(space.static_body, body, 0.0, 1.0)
    twist.max_bias, twist.max_force = 0.0, _LEVER * prism.radius * weight
    space.add(body, shape, drag, twist)
    return body
