"""Objects as prisms that slide, turn and touch on the plane of the table when the closed fingers push them.

The physics is Chipmunk's (pymunk), seen from above, with the table's friction added as Coulomb's. It knows nothing of
toppling and stacks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import pymunk

from robotcell.geometry import rg2

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

_GRAVITY_M_S2 = 9.81
# Of painted wood, of rubber on it, and of the table under it (assumed, as the twin does); those of two objects that
# touch are multiplied.
_OBJECT_FRICTION = 0.8
_FINGER_FRICTION = 1.0
_TABLE_FRICTION = 0.48
# Share of the radius at which friction acts against turning: two thirds for a disc that only turns, less for what
# slides as well. Set by comparing plays with the twin.
_LEVER = 0.4
# Twice as fast as the arm: friction of the table makes the outcome depend on the way alone.
_SPEED_M_S = 0.16
# Half as long a step tells pushes that help apart no better.
_STEP_S = 1 / 60
# Outlines overlap by noise: so much is left alone, and most of what is more goes within a second.
_OVERLAP_M = 0.0006
_LEFT_OVERLAP = 0.9**120
# What went or turned less than this did not move.
_MOVED_M, _TURNED_RAD = 0.0005, 0.02
# An outline that fills less of its hull is concave, and halved until its pieces are not, or too small to matter.
_CONVEX = 0.82
_LEAST_PART_M2 = 36e-6
# What shows less than this of itself is noise.
_LEAST_OBJECT_M2 = 48e-6
# Which of the shapes meet: objects each other, and what is high enough the tips and the cranks.
_OBJECT, _REACHES_TIPS, _REACHES_CRANKS = 0b001, 0b010, 0b100
# Objects so far behind the start or beyond the end of a push, and to its sides no farther than it is long, take part.
_BEYOND_M = 0.10


@dataclass(frozen=True)
class Prism:
    """An object seen from above.

    Attributes:
        parts: convex polygons, each (N, 2) x and y [m] from the middle.
        center: (2,) x and y of the middle [m from the map's corner].
        height_m: of its top.
        reach_m: distance from the middle to the farthest corner.
    """

    parts: tuple[Array, ...]
    center: Array
    height_m: float
    reach_m: float

    @staticmethod
    def of(own: npt.NDArray[np.bool_], corner: tuple[int, int], height_m: float, resolution_m: float) -> Prism | None:
        """From the cells (h, w) of an object, the first at row and column `corner`; None for less than an object."""
        rows, cols = np.nonzero(own)
        if len(rows) < round(_LEAST_OBJECT_M2 / resolution_m**2):
            return None
        middle = np.array([cols.mean(), rows.mean()])
        parts = tuple(
            (part - middle) * resolution_m
            for part in _convex_parts(own.astype(np.uint8), _LEAST_PART_M2 / resolution_m**2)
        )
        if not parts:
            return None
        reach_m = max(float(np.hypot(*part.T).max()) for part in parts)
        return Prism(parts, (middle + 0.5 + corner[::-1]) * resolution_m, height_m, reach_m)


class _Body(NamedTuple):
    """A prism's body, its shapes, and the joints that are its friction on the table."""

    body: pymunk.Body
    shapes: tuple[pymunk.Shape, ...]
    joints: tuple[pymunk.Constraint, ...]


class PlanarPhysics:
    """Prisms that closed fingers push over the plane of the table; at rest before every push.

    Args:
        prisms: by label.
    """

    def __init__(self, prisms: dict[int, Prism]) -> None:
        self._labels = list(prisms)
        self._centers = np.array([prism.center for prism in prisms.values()]).reshape(-1, 2)
        self._heights = np.array([prism.height_m for prism in prisms.values()])
        self._reaches = np.array([prism.reach_m for prism in prisms.values()])
        self._ground = pymunk.Body(body_type=pymunk.Body.STATIC)
        # To make bodies takes longer than a push: they are made once, and belong to a space while they take part.
        self._bodies = [_body(self._ground, prism) for prism in prisms.values()]
        self._fingers = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self._gripper = (
            _fingers_shape(self._fingers, rg2.FINGER_THICKNESS_M, _REACHES_TIPS),
            _fingers_shape(self._fingers, rg2.CRANKS_M[0], _REACHES_CRANKS),
        )

    def push(self, start: Array, theta: float, length_m: float, tip_m: float) -> dict[int, Array]:
        """Move the closed fingers along a line; returns the move of each object that moved, by label.

        A move is (3, 3), from x, y [m] and 1 on the map before to those after.

        Args:
            start: (2,) x and y [m] where they begin.
            theta: direction [rad].
            length_m: how far they go.
            tip_m: height of their tips above the table; they pass over what is lower.
        """
        along = np.array([math.cos(theta), math.sin(theta)])
        taking_part, free_m = self._ahead(start, along, length_m, tip_m)
        steps = round(length_m / _SPEED_M_S / _STEP_S)
        # Until they meet something nothing happens.
        idle = min(steps, max(0, int(free_m / (_SPEED_M_S * _STEP_S))))
        x, y = start + idle * _SPEED_M_S * _STEP_S * along
        self._fingers.position, self._fingers.angle = (float(x), float(y)), theta
        self._fingers.velocity = (float(_SPEED_M_S * along[0]), float(_SPEED_M_S * along[1]))
        # A space of its own for every push: joints remember what they held in the last step of their space.
        space = pymunk.Space()
        space.collision_slop, space.collision_bias = _OVERLAP_M, _LEFT_OVERLAP
        space.add(self._ground, self._fingers, *self._gripper)
        for i in taking_part:
            body, shapes = self._bodies[i].body, self._bodies[i].shapes
            reaches = _REACHES_TIPS * bool(self._heights[i] > tip_m)
            reaches |= _REACHES_CRANKS * bool(self._heights[i] > tip_m + rg2.CRANKS_ABOVE_TIPS_M)
            for shape in shapes:
                shape.filter = pymunk.ShapeFilter(categories=_OBJECT | reaches)
            body.position, body.angle = tuple(self._centers[i].tolist()), 0.0
            body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
            space.add(body, *shapes, *self._bodies[i].joints)
        for _ in range(steps - idle):
            space.step(_STEP_S)
        moves = {self._labels[i]: move for i in taking_part if (move := self._move(i)) is not None}
        space.remove(self._ground, self._fingers, *self._gripper)
        for i in taking_part:
            space.remove(*self._bodies[i].shapes, *self._bodies[i].joints)
        # Uses up what the last step left to each body against its overlaps.
        space.step(_STEP_S)
        for i in taking_part:
            space.remove(self._bodies[i].body)
        return moves

    def _ahead(self, start: Array, along: Array, length_m: float, tip_m: float) -> tuple[list[int], float]:
        """Indices of the objects that may take part, and how far the fingers go before they can meet one."""
        rel = self._centers - start
        ahead, aside = rel @ along, np.abs(rel @ np.array([-along[1], along[0]]))
        part = (ahead > -_BEYOND_M) & (ahead < 2 * length_m + _BEYOND_M) & (aside < length_m)
        fingers = math.hypot(rg2.CRANKS_M[0], rg2.FINGER_BREADTH_M / 2) + _OVERLAP_M
        met = part & (aside < self._reaches + fingers) & (self._heights > tip_m)
        free_m = (ahead - self._reaches)[met].min() - fingers if met.any() else length_m
        return np.flatnonzero(part).tolist(), float(free_m)

    def _move(self, i: int) -> Array | None:
        body, (x, y) = self._bodies[i].body, self._centers[i]
        at, cos, sin = body.position, math.cos(body.angle), math.sin(body.angle)
        if max(abs(at.x - x), abs(at.y - y)) <= _MOVED_M and abs(sin) <= _TURNED_RAD:
            return None
        return np.array([[cos, -sin, at.x - cos * x + sin * y], [sin, cos, at.y - sin * x - cos * y], [0.0, 0.0, 1.0]])


def _fingers_shape(fingers: pymunk.Body, half_thickness_m: float, meets: int) -> pymunk.Shape:
    shape = pymunk.Poly.create_box(fingers, (2 * half_thickness_m, rg2.FINGER_BREADTH_M))
    shape.friction = _FINGER_FRICTION
    shape.filter = pymunk.ShapeFilter(mask=meets)
    return shape


def _body(ground: pymunk.Body, prism: Prism) -> _Body:
    parts = [[(float(x), float(y)) for x, y in part] for part in prism.parts]
    areas = [cv2.contourArea(part.astype(np.float32)) for part in prism.parts]
    # The density is the same for all, and its value without meaning.
    masses = [area * prism.height_m for area in areas]
    moment = sum(pymunk.moment_for_poly(mass, part) for mass, part in zip(masses, parts, strict=True))
    body = pymunk.Body(sum(masses), moment)
    shapes = [pymunk.Poly(body, part) for part in parts]
    for shape in shapes:
        shape.friction = _OBJECT_FRICTION
    # Coulomb's friction of the table: joints that may slip, and pull back to no place.
    weight = _TABLE_FRICTION * _GRAVITY_M_S2 * body.mass
    drag = pymunk.PivotJoint(ground, body, (0, 0), (0, 0))
    drag.max_bias, drag.max_force = 0.0, weight
    twist = pymunk.GearJoint(ground, body, 0.0, 1.0)
    twist.max_bias, twist.max_force = 0.0, _LEVER * math.sqrt(sum(areas) / math.pi) * weight
    return _Body(body, tuple(shapes), (drag, twist))


def _convex_parts(own: npt.NDArray[np.uint8], least_area: float) -> list[Array]:
    """Convex polygons, each (N, 2) column and row, that cover an object (h, w): its hull, or those of its halves.

    Pieces of an area [cells] below `least_area` are left out.
    """
    parts: list[Array] = []
    contours, _ = cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        hull = cv2.convexHull(contour)
        area = cv2.contourArea(hull)
        if area < least_area:
            continue
        if cv2.contourArea(contour) > _CONVEX * area:
            parts.append(hull[:, 0].astype(np.float64))
            continue
        # This piece alone: others may reach into its box.
        col, row, cols, rows = cv2.boundingRect(contour)
        piece = own * cv2.drawContours(np.zeros_like(own), [contour], 0, 1, cv2.FILLED).astype(np.uint8)
        for half in range(2):
            window = [slice(row, row + rows), slice(col, col + cols)]
            axis, middle = (0, row + rows // 2) if rows > cols else (1, col + cols // 2)
            window[axis] = slice(window[axis].start, middle) if half == 0 else slice(middle, window[axis].stop)
            corner = np.array([window[1].start, window[0].start])
            parts += [part + corner for part in _convex_parts(np.ascontiguousarray(piece[tuple(window)]), least_area)]
    return parts
