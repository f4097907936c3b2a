"""What a push would do, played ahead on the plane of the table: objects as prisms that slide, turn and touch.

The physics is Chipmunk's (pymunk), seen from above, with the table's friction added as Coulomb's. It knows nothing of
toppling and stacks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import pymunk
from scipy.ndimage import find_objects

from policy.border import border_cells, stands
from robotcell import linkage
from robotcell.decision import ROTATIONS
from robotcell.perception import MIN_OBJECT_M

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
_STEP_S = 1 / 120
# Outlines overlap by noise: so much is left alone, and a tenth of what is more goes in every step.
_OVERLAP_M = 0.0006
_LEFT_OVERLAP = 0.9**120
# An outline that fills less of its hull is concave, and halved until its pieces are not, or too small to matter.
_CONVEX = 0.82
_LEAST_PART_CELLS = 9
# An object of fewer cells is noise.
_LEAST_CELLS = 12
# What is pushed nearer to the rim of the map than this, and not just along it, may leave it or leaves no room for a
# finger.
_RIM_M = 0.03
# The window of an object shows so much around it: farther than fingers that grasp it reach, and than its border.
_AROUND_M = 0.07
_STAYS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# The fingers pass over what is lower than their tips, with so much to spare.
_CLEAR_M = 0.002


@dataclass(frozen=True)
class _Prism:
    """An object: convex `parts`, each (N, 2) x and y in metres from the map's corner, their middle, and its height."""

    parts: tuple[Array, ...]
    center: Array
    height_m: float

    @cached_property
    def outline(self) -> Array:
        return np.concatenate(self.parts)

    @cached_property
    def areas(self) -> tuple[float, ...]:
        return tuple(float(cv2.contourArea(part.astype(np.float32))) for part in self.parts)

    @cached_property
    def radius(self) -> float:
        return math.sqrt(sum(self.areas) / math.pi)


@dataclass(frozen=True)
class Played:
    """What came of a push.

    Attributes:
        moves: (2, 3) by label of each object that moved: the map's x and y [m] before to those after.
        lost: whether one of them came so near to the rim of the workspace that it may leave it.
    """

    moves: dict[int, Array]
    lost: bool


_NOTHING = Played({}, lost=False)


class Window(NamedTuple):
    """The part of the map around an object.

    Attributes:
        top, left: row and column of the map at its first cell; negative where it reaches beyond the map.
        own: (h, w) cells of the object.
        border: (N, 2) row and column, in the window, of the cells around the object.
    """

    top: int
    left: int
    own: npt.NDArray[np.bool_]
    border: npt.NDArray[np.intp]


class Foresight:
    """The objects of one view.

    Args:
        labels: (H, W) the object in each cell, 0 for none.
        height_m: (H, W) with closed gaps, NaN where nothing was seen.
        resolution_m: size of a cell.
    """

    def __init__(self, labels: npt.NDArray[np.integer], height_m: npt.NDArray[np.float32], resolution_m: float) -> None:
        self._height_m = np.nan_to_num(height_m, nan=0.0)
        self._resolution_m = resolution_m
        boxes = find_objects(labels)
        self._cells = {i: (box, labels[box] == i) for i, box in enumerate(boxes, start=1) if box is not None}
        self._alone = {i: np.where(own, self._height_m[box], np.float32(0)) for i, (box, own) in self._cells.items()}
        self._prisms = {i: prism for i in self._cells if (prism := self._prism(i)) is not None}
        self._windows: dict[int, Window] = {}
        self._occupied: dict[int, float] = {}

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

    def window(self, label: int) -> Window:
        """What is seen of an object and of what stands around it."""
        if label not in self._windows:
            (rows, cols), own = self._cells[label]
            pad = math.ceil(_AROUND_M / self._resolution_m)
            border = border_cells(np.pad(own, pad))
            self._windows[label] = Window(rows.start - pad, cols.start - pad, np.pad(own, pad), border)
        return self._windows[label]

    def around(self, label: int, played: Played) -> npt.NDArray[np.float32]:
        """(h, w) heights in the window of an object after a push; the window goes and turns with the object."""
        window = self.window(label)
        here = played.moves.get(label, _STAYS)
        others = {other: move for other, move in played.moves.items() if other != label}
        heights = self._after((window.top, window.left), window.own.shape, here, others, {*others, label})
        box, cells = self._cells[label]
        heights[window.own] = self._height_m[box][cells]
        return heights

    def uncovered(self, cells: npt.NDArray[np.bool_], played: Played) -> float:
        """Share of cells (H, W) on which nothing stands any more after a push."""
        heights = self._after((0, 0), cells.shape, _STAYS, played.moves, set(played.moves))
        return float((heights[cells] < MIN_OBJECT_M).mean())

    def freed(self, label: int, around: npt.NDArray[np.float32]) -> float:
        """How much of an object's border a push frees: the fall in the share that others stand on (paper, stage II).

        Args:
            label: of the object.
            around: what the push makes of its window.
        """
        if label not in self._occupied:
            self._occupied[label] = self._share(label, self.around(label, _NOTHING))
        return self._occupied[label] - self._share(label, around)

    def _share(self, label: int, around: npt.NDArray[np.float32]) -> float:
        rows, cols = self.window(label).border.T
        return float(stands(around[rows, cols]).mean())

    def _after(
        self,
        corner: tuple[int, int],
        size: tuple[int, ...],
        here: Array,
        moves: dict[int, Array],
        gone: set[int],
    ) -> npt.NDArray[np.float32]:
        """(h, w) heights after a push in a window of the map.

        Args:
            corner: row and column of the map at its first cell.
            size: its rows and columns.
            here: (2, 3) the window's own move.
            moves: of the objects that are shown where they came to.
            gone: labels of those that are not shown where they were.
        """
        rest = self._height_m.copy()
        for label in gone:
            box, cells = self._cells[label]
            rest[box][cells] = 0.0
        heights = self._warped(rest, (0, 0), here, corner, size)
        for label, move in moves.items():
            (rows, cols), _ = self._cells[label]
            way = _then(here, _inverse(move))
            shown = self._warped(self._alone[label], (rows.start, cols.start), way, corner, size)
            np.maximum(heights, shown, out=heights)
        return heights

    def _warped(
        self,
        height_m: npt.NDArray[np.float32],
        start: tuple[int, int],
        move: Array,
        corner: tuple[int, int],
        size: tuple[int, ...],
    ) -> npt.NDArray[np.float32]:
        """A part of the map, its first cell at `start`, as a window shows it; `move` from the window to the part."""
        turn = move[:, :2]
        half = np.array(corner[::-1]) + 0.5
        shift = turn @ half + move[:, 2] / self._resolution_m - 0.5 - np.array(start[::-1])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(height_m, np.column_stack([turn, shift]), size[::-1], flags=flags), np.float32)

    def _prism(self, label: int) -> _Prism | None:
        (rows, cols), own = self._cells[label]
        if np.count_nonzero(own) < _LEAST_CELLS:
            return None
        corner = np.array([cols.start, rows.start]) + 0.5
        parts = tuple((part + corner) * self._resolution_m for part in _convex_parts(own))
        middle = np.argwhere(own).mean(axis=0)[::-1]
        height_m = float(np.percentile(self._height_m[rows, cols][own], 90))
        return _Prism(parts, (middle + corner) * self._resolution_m, height_m) if parts else None

    def _outcome(self, bodies: dict[int, pymunk.Body]) -> Played:
        moves, lost = {}, False
        for label, body in bodies.items():
            prism = self._prisms[label]
            before = prism.center
            cos, sin = math.cos(body.angle), math.sin(body.angle)
            # The body's frame was at the middle of the outline.
            after = np.array([body.position.x, body.position.y])
            if np.abs(after - before).max() > self._resolution_m / 4 or abs(sin) > 0.02:
                turn = np.array([[cos, -sin], [sin, cos]])
                moves[label] = move = np.column_stack([turn, after - turn @ before])
                margin = self._margin(prism.outline @ move[:, :2].T + move[:, 2])
                lost = lost or margin < min(_RIM_M, self._margin(prism.outline) - self._resolution_m)
        return Played(moves, lost)

    def _margin(self, outline: Array) -> float:
        """Distance [m] from the rim of the map, negative beyond it."""
        size = np.array(self._height_m.shape[::-1]) * self._resolution_m
        return float(min(outline.min(), (size - outline).min()))


def _then(first: Array, second: Array) -> Array:
    """Two moves (2, 3), one after the other."""
    return np.column_stack([second[:, :2] @ first[:, :2], second[:, :2] @ first[:, 2] + second[:, 2]])


def _inverse(move: Array) -> Array:
    back = move[:, :2].T
    return np.column_stack([back, -back @ move[:, 2]])


def _convex_parts(own: npt.NDArray[np.bool_]) -> list[Array]:
    """Convex polygons, each (N, 2) column and row, that cover an object (h, w): its hull, or those of its halves."""
    parts: list[Array] = []
    contours, _ = cv2.findContours(own.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        hull = cv2.convexHull(contour)
        area = cv2.contourArea(hull)
        if area < _LEAST_PART_CELLS:
            continue
        if cv2.contourArea(contour) > _CONVEX * area:
            parts.append(hull[:, 0].astype(np.float64))
            continue
        col, row, cols, rows = cv2.boundingRect(contour)
        for half in range(2):
            window = [slice(row, row + rows), slice(col, col + cols)]
            axis, middle = (0, row + rows // 2) if rows > cols else (1, col + cols // 2)
            window[axis] = slice(window[axis].start, middle) if half == 0 else slice(middle, window[axis].stop)
            corner = np.array([window[1].start, window[0].start])
            parts += [part + corner for part in _convex_parts(own[tuple(window)])]
    return parts


def _add(space: pymunk.Space, prism: _Prism) -> pymunk.Body:
    parts = [[(float(x), float(y)) for x, y in part - prism.center] for part in prism.parts]
    # The density is the same for all, and its value without meaning.
    masses = [area * prism.height_m for area in prism.areas]
    moment = sum(pymunk.moment_for_poly(mass, part) for mass, part in zip(masses, parts, strict=True))
    body = pymunk.Body(sum(masses), moment)
    body.position = (float(prism.center[0]), float(prism.center[1]))
    shapes = [pymunk.Poly(body, part) for part in parts]
    for shape in shapes:
        shape.friction = _OBJECT_FRICTION
    # Coulomb's friction of the table: joints that may slip, and pull back to no place.
    weight = _TABLE_FRICTION * _GRAVITY_M_S2 * body.mass
    drag = pymunk.PivotJoint(space.static_body, body, (0, 0), (0, 0))
    drag.max_bias, drag.max_force = 0.0, weight
    twist = pymunk.GearJoint(space.static_body, body, 0.0, 1.0)
    twist.max_bias, twist.max_force = 0.0, _LEVER * prism.radius * weight
    space.add(body, *shapes, drag, twist)
    return body
