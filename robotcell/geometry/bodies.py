"""A model of arm, gripper and obstacles that is coarse, conservative and fast: spheres, and points for the fingers.

Each link is a chain of spheres along its axis, in the frames of `ur5e.link_frames`. Radii cover the housings of
the UR5e (joint housings 120 to 150 mm, upper arm 110 mm, forearm 90 mm and wrists 90 mm across) and of the RG2's body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.geometry import rg2, ur5e

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

# Distance of the upper arm's tube from the plane of the base, along the shoulder axis (UR5e drawing: 0.138 m).
_UPPER_ARM_OFFSET_M = 0.138
_SPACING_M = 0.03
FINGER_SPACING_M = 0.014


@dataclass(frozen=True)
class Spheres:
    """Spheres fixed to links.

    Attributes:
        link: (N,) index of the frame that carries each sphere, 0 base .. 6 flange.
        center: (N, 3) in that frame [m].
        radius: (N,) [m].
        group: (N,) index of the body that it belongs to, in order from the base.
    """

    link: npt.NDArray[np.int64]
    center: Array
    radius: Array
    group: npt.NDArray[np.int64]


# (frame, start, end, radius) of each body in order from the base.
_BODIES = (
    (0, (0.0, 0.0, 0.03), (0.0, 0.0, 0.1625), 0.075),
    (1, (0.0, 0.0, 0.0), (0.0, 0.0, _UPPER_ARM_OFFSET_M), 0.070),
    (2, (0.425, 0.0, _UPPER_ARM_OFFSET_M), (0.0, 0.0, _UPPER_ARM_OFFSET_M), 0.060),
    (2, (0.0, 0.0, _UPPER_ARM_OFFSET_M), (0.0, 0.0, 0.0), 0.060),
    (3, (0.3922, 0.0, 0.015), (0.0, 0.0, 0.015), 0.055),
    (4, (0.0, -0.1333, 0.0), (0.0, 0.0, 0.0), 0.050),
    (5, (0.0, 0.0997, 0.0), (0.0, 0.0, 0.0), 0.048),
    (6, (0.0, 0.0, -0.05), (0.0, 0.0, 0.0), 0.045),
    (6, (0.0, 0.0, 0.05), (0.0, 0.0, rg2.PALM_M), 0.055),
)
# What errors call the bodies.
BODY_NAMES = (
    "base",
    "shoulder",
    "upper arm",
    "elbow",
    "forearm",
    "first wrist",
    "second wrist",
    "third wrist",
    "gripper",
)
# The gripper's body, which `tool_points` has in more detail.
GRIPPER_GROUP = 8
# Bodies this many places apart in the chain share a joint housing or a neighbour's, and cannot touch.
_NEIGHBOURS = 2
# Fingers, open any way, and a load lie within so many spheres of this radius.
_HAND_SPHERES, _HAND_M = 5, 0.070
_FOREARM = 4


def robot_spheres() -> Spheres:
    """The spheres of arm and gripper body, without the fingers (their tips are checked as the tcp)."""
    link, center, radius, group = [], [], [], []
    for index, (frame, start, end, r) in enumerate(_BODIES):
        length = float(np.linalg.norm(np.subtract(end, start)))
        for s in np.linspace(0.0, 1.0, max(2, int(np.ceil(length / _SPACING_M)) + 1)):
            link.append(frame)
            center.append((1 - s) * np.array(start) + s * np.array(end))
            radius.append(r)
            group.append(index)
    return Spheres(np.array(link), np.array(center), np.array(radius), np.array(group))


SPHERES = robot_spheres()
# Bodies are listed from the base on, so the spheres of a link follow each other.
_CENTERS_BY_LINK = [(int(link), SPHERES.center[SPHERES.link == link]) for link in np.unique(SPHERES.link)]


def sphere_centers(q: npt.ArrayLike) -> Array:
    """Centres (..., N, 3) of `SPHERES` in the base frame [m] at joint angles (..., 6)."""
    return _in_base(ur5e.link_frames(q))


def _in_base(frames: Array) -> Array:
    """Centres (..., N, 3) of `SPHERES` [m] for the frames (..., 7, 4, 4) of the links, link by link."""
    return np.concatenate(
        [
            center @ np.swapaxes(frames[..., link, :3, :3], -1, -2) + frames[..., None, link, :3, 3]
            for link, center in _CENTERS_BY_LINK
        ],
        axis=-2,
    )


def box_distance(low: Array, high: Array, points: Array) -> npt.NDArray[np.float64]:
    """Distance [m] of points (..., 3) from the box between the corners `low` and `high` (3,); 0 inside."""
    return _length(np.maximum(0.0, np.maximum(low - points, points - high)))


def self_distance(centers: Array) -> npt.NDArray[np.float64]:
    """Smallest gap (...,) [m] between bodies that are not neighbours, of sphere centres (..., N, 3)."""
    return np.asarray(
        (
            _length(centers[..., _PAIRS[0], :] - centers[..., _PAIRS[1], :])
            - (SPHERES.radius[_PAIRS[0]] + SPHERES.radius[_PAIRS[1]])
        ).min(axis=-1)
    )


def hand_distance(centers: Array, T_base_tcp: Array, load_m: float) -> npt.NDArray[np.float64]:
    """Smallest gap (N,) [m] between the fingers with a load and the arm up to its forearm.

    Args:
        centers: sphere centres (N, M, 3).
        T_base_tcp: poses (N, 4, 4) of the tcp.
        load_m: how far a load reaches below the tcp; 0 without one.
    """
    along = np.linspace(-rg2.BODY_ABOVE_TIPS_M, load_m, _HAND_SPHERES)
    hand = T_base_tcp[:, None, :3, 3] + along[:, None] * T_base_tcp[:, None, :3, 2]
    arm = SPHERES.group <= _FOREARM
    apart = _length(hand[:, :, None] - centers[:, None, arm])
    return np.asarray((apart - _HAND_M - SPHERES.radius[arm]).min(axis=(1, 2)))


def finger_points(T_base_tcp: Array, load_m: float) -> Array:
    """Points (..., K, 3) [m] that stand for the fingers and for a load that reaches `load_m` below the tcp.

    They fill the block that the fingers can be in, from palm to tip and opened any way, at most
    `FINGER_SPACING_M` apart.
    """
    half = rg2.MAX_WIDTH_M / 2 + rg2.FINGER_THICKNESS_M
    x = np.linspace(-half, half, int(2 * half / FINGER_SPACING_M) + 2)
    y = np.array([-0.5, 0.0, 0.5]) * rg2.FINGER_BREADTH_M
    reach = rg2.CLOSED_LENGTH_M - rg2.PALM_M + load_m
    z = load_m - np.linspace(0.0, reach, int(reach / FINGER_SPACING_M) + 2)
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(grid @ np.swapaxes(T_base_tcp[..., :3, :3], -1, -2) + T_base_tcp[..., None, :3, 3])


@dataclass(frozen=True)
class ToolPoints:
    """Small spheres that cover the gripper at one opening, and a load in it, in the frame of the tcp.

    Attributes:
        points: (N, 3) centres, tcp frame [m].
        radius_m: of all of them.
        body: (N,) True for the gripper's body, False for cranks, fingers and load.
    """

    points: Array
    radius_m: float
    body: npt.NDArray[np.bool_]


# Radius of the small spheres. Their centres are at most 1.6 radii apart: they then cover a face up to 2 mm.
TOOL_POINT_M = 0.008
# A load reaches so far from the middle across the closing direction: the longest block is 100 mm.
_LOAD_HALF_M = 0.050


@lru_cache(maxsize=32)
def tool_points(opening_m: float, load_m: float) -> ToolPoints:
    """Spheres that cover the gripper's body, and fingers and load at an opening.

    Args:
        opening_m: between the finger tips, in the range of the gripper.
        load_m: how far a load reaches below the tcp; 0 without one.
    """
    retracted = -rg2.tip_retraction(opening_m)
    body_z = -rg2.BODY_ABOVE_TIPS_M
    body = _box_points((-rg2.BODY_M[0], -rg2.BODY_M[1], body_z - 0.112), (rg2.BODY_M[0], rg2.BODY_M[1], body_z))
    half, breadth = opening_m / 2, rg2.FINGER_BREADTH_M / 2
    knuckle = retracted - rg2.KNUCKLE_TO_TIP_M
    fingers = []
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * half, side * (half + rg2.FINGER_THICKNESS_M)))
        fingers.append(_box_points((inner, -breadth, knuckle), (outer, breadth, retracted)))
        # The cranks, from the pivots behind the palm to the knuckles.
        start = np.array([side * rg2.PIVOT_OFFSET_M, 0.0, -(rg2.CLOSED_LENGTH_M - rg2.PIVOTS_M)])
        end = np.array([side * (half + rg2.FINGER_THICKNESS_M / 2), 0.0, knuckle])
        along = np.linspace(0.0, 1.0, 5)[:, None] * (end - start) + start
        fingers.extend(along + np.array([0.0, y, 0.0]) for y in (-rg2.CRANKS_M[1] / 2, rg2.CRANKS_M[1] / 2))
    if load_m > 0:
        fingers.append(_box_points((-half, -_LOAD_HALF_M, retracted), (half, _LOAD_HALF_M, load_m)))
    points = np.concatenate([body, *fingers])
    points.flags.writeable = False
    return ToolPoints(points, TOOL_POINT_M, np.arange(len(points)) < len(body))


def _box_points(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """Centres (N, 3) on the faces of a box, of spheres of `TOOL_POINT_M` that cover it."""
    axes = []
    for a, b in zip(low, high, strict=True):
        inset = min(TOOL_POINT_M / 2, (b - a) / 2)
        count = int(np.ceil((b - a - 2 * inset) / (1.6 * TOOL_POINT_M))) + 1
        axes.append(np.linspace(a + inset, b - inset, count))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    faces = np.zeros(len(grid), np.bool_)
    for axis, values in enumerate(axes):
        faces |= (grid[:, axis] == values[0]) | (grid[:, axis] == values[-1])
    return np.asarray(grid[faces])


def blocks_view(
    q: npt.ArrayLike,
    eye: Array,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    table_height_m: float,
    load_m: float = 0.0,
) -> bool:
    """Whether arm, gripper or a load stand between a camera and a rectangle of the table.

    Args:
        q: joint angles (6,) [rad].
        eye: position (3,) of the camera, base frame [m].
        x_range: of the rectangle, base frame [m].
        y_range: likewise.
        table_height_m: z of the table, base frame.
        load_m: how far a load reaches from the tcp, down and to any side; 0 without one.
    """
    T_tcp = ur5e.forward(q) @ rg2.T_FLANGE_TCP
    fingers = finger_points(T_tcp, 0.0)
    centers = np.concatenate([sphere_centers(q), fingers, T_tcp[None, :3, 3]])
    radii = np.concatenate([SPHERES.radius, np.full(len(fingers), FINGER_SPACING_M), [load_m]])
    below = centers[:, 2] < eye[2] - radii
    away = centers[below] - eye
    # Their shadows on the table, as if the camera were a lamp.
    stretch = (eye[2] - table_height_m) / -away[:, 2]
    x, y = (eye[:2] + stretch[:, None] * away[:, :2]).T
    size = radii[below] * stretch * np.linalg.norm(away, axis=1) / -away[:, 2]
    (x0, x1), (y0, y1) = x_range, y_range
    return bool(((x > x0 - size) & (x < x1 + size) & (y > y0 - size) & (y < y1 + size)).any())


def _length(vectors: Array) -> Array:
    """Lengths (...,) of vectors (..., 3); several times as fast as the general norm."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _sphere_pairs() -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    i, j = np.triu_indices(len(SPHERES.group), k=1)
    apart = SPHERES.group[j] - SPHERES.group[i] > _NEIGHBOURS
    return i[apart], j[apart]


_PAIRS = _sphere_pairs()
