"""Where the arm holds the board for each view: spread over the image, in depth and in direction, and safe to go to.

Poses are drawn in the camera's frame, where it is easy to say what a good view is, and kept where the arm can hold
them. Of those that are left, the ones that differ most from each other are taken, and put in an order of short ways.
The camera's pose is only a guess at this point: it decides what is visible. Of what is safe it only says where things
stand, with room for how wrong it may be.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.collect.board_motion import FLANGE, plan_motion
from calibration.solve.se3 import invert, log
from robotcell.errors import UnsafeMotion
from robotcell.geometry import bodies, ur5e
from robotcell.geometry.transforms import Array, invert_transform, make_transform, transform_points
from robotcell.perception.board_plate import size_m

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calibration.target.held_board import HeldBoard
    from robotcell.config import CellConfig
    from robotcell.interfaces import Intrinsics
    from robotcell.perception.clearance_map import ClearanceMap

# Beyond this, corners of a printed board get uncertain and its depth is lost to reflections.
MAX_TILT_RAD = np.radians(45)
# D415 data sheet: no depth nearer than 0.45 m at 1280x720.
_NEAREST_M = 0.46
# A square must be at least this wide in the image, or its marker cannot be read.
_MIN_SQUARE_PX = 20
# The board stays this share of the image away from its border: the guess of the camera's pose may be some degrees off.
_MARGIN = 0.06
# So many candidates for each view that is asked for, and so many draws for each candidate.
_CANDIDATES = 5
_DRAWS = 40
# Two views differ by one when the board is so far away from itself, or so turned.
_FAR_M = 0.15
_TURNED_RAD = 0.5
_VIA_DRAWS = 600
_VIA_POSES = 10


@dataclass(frozen=True)
class ViewPlan:
    """Where to take views.

    Attributes:
        q_via: joint angles (6,) of a pose through which every view can be gone to.
        views: joint angles (6,) of the views, in the order to go to them.
    """

    q_via: Array
    views: tuple[Array, ...]


def plan_views(
    config: CellConfig,
    held: HeldBoard,
    T_base_camera: Array,
    intrinsics: Intrinsics,
    count: int,
    seed: int,
    q_start: Array,
    taken: Sequence[Array] = (),
    seen: ClearanceMap | None = None,
) -> ViewPlan:
    """Up to `count` views; the same arguments give the same plan.

    Args:
        config: of the cell.
        held: the board.
        T_base_camera: where the camera is thought to stand (4, 4).
        intrinsics: of its colour image.
        count: how many views.
        seed: of the draw.
        q_start: where the arm stands (6,) [rad].
        taken: T_camera_board of the views that exist already; the new ones differ from them.
        seen: what may stand on the table; None if nobody looked.

    Raises:
        UnsafeMotion: there is no pose to begin with; the message says what stood in the way.
    """
    rng = np.random.default_rng([seed, len(taken)])
    refused: Counter[str] = Counter()
    q_via = _find_via_pose(config, held, T_base_camera, intrinsics, rng, q_start, refused, seen)
    if q_via is None:
        reasons = ", ".join(f"{reason} ({times} times)" for reason, times in refused.most_common(3))
        raise UnsafeMotion(
            f"no pose of the arm shows the board to the camera: {reasons}. Check the camera's place in cell.toml, the "
            "workspace and the keep-outs, how the board is held, and that the arm can leave the pose that it is in"
        )
    poses, joints = _candidates(config, held, T_base_camera, intrinsics, count * _CANDIDATES, rng, q_via, seen)
    chosen = _most_different(poses, list(taken), count)
    return ViewPlan(q_via, tuple(_in_order([joints[i] for i in chosen], q_start)))


def visible(T_camera_board: Array, held: HeldBoard, intrinsics: Intrinsics) -> bool:
    """Whether the camera sees the whole board, near and straight enough."""
    width, height = size_m(held.board)
    corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]])
    points = transform_points(T_camera_board, corners)
    z = points[:, 2]
    if z.min() < _NEAREST_M or intrinsics.fx * held.board.square_m / z.max() < _MIN_SQUARE_PX:
        return False
    u, v = intrinsics.fx * points[:, 0] / z + intrinsics.cx, intrinsics.fy * points[:, 1] / z + intrinsics.cy
    margin_u, margin_v = _MARGIN * intrinsics.width, _MARGIN * intrinsics.height
    inside = (u > margin_u) & (u < intrinsics.width - margin_u) & (v > margin_v) & (v < intrinsics.height - margin_v)
    # The angle at which the line of sight meets the board.
    middle = transform_points(T_camera_board, held.center)
    facing = float(T_camera_board[:3, 2] @ middle / np.linalg.norm(middle))
    return bool(inside.all() and facing > np.cos(MAX_TILT_RAD))


def _find_via_pose(
    config: CellConfig,
    held: HeldBoard,
    T_base_camera: Array,
    intrinsics: Intrinsics,
    rng: np.random.Generator,
    q_start: Array,
    refused: Counter[str],
    seen: ClearanceMap | None,
) -> Array | None:
    """Joint angles of a pose in the middle of the view that the arm can go to, the nearest of several; or None."""
    found: list[Array] = []
    for _ in range(_VIA_DRAWS):
        T_camera_board = _draw(held, intrinsics, rng, middle=True)
        q = ur5e.inverse(T_base_camera @ T_camera_board @ invert_transform(held.T_flange_board), q_start)
        if q is None:
            refused["out of reach"] += 1
            continue
        if _occluded(q, held, T_base_camera[:3, 3]):
            refused["the arm hides the board"] += 1
            continue
        try:
            plan_motion("first view", q_start, q, held, config, seen)
        except UnsafeMotion as error:
            refused[str(error).partition(": ")[2]] += 1
            continue
        found.append(q)
        if len(found) == _VIA_POSES:
            break
    return min(found, key=lambda q: float(np.abs(q - q_start).max()), default=None)


def _candidates(
    config: CellConfig,
    held: HeldBoard,
    T_base_camera: Array,
    intrinsics: Intrinsics,
    count: int,
    rng: np.random.Generator,
    q_via: Array,
    seen: ClearanceMap | None,
) -> tuple[list[Array], list[Array]]:
    """T_camera_board and joint angles of poses that are visible and that the arm can go to from the via pose."""
    T_board_flange = invert_transform(held.T_flange_board)
    joints = [q_via]
    poses = [np.asarray(invert_transform(T_base_camera) @ ur5e.forward(q_via) @ held.T_flange_board)]
    for _ in range(count * _DRAWS):
        if len(poses) == count:
            break
        T_camera_board = _draw(held, intrinsics, rng)
        if not visible(T_camera_board, held, intrinsics):
            continue
        q = ur5e.inverse(T_base_camera @ T_camera_board @ T_board_flange, q_via)
        if q is None or _occluded(q, held, T_base_camera[:3, 3]):
            continue
        try:
            # Where the arm cannot stand it cannot go either, and that is sooner found out.
            plan_motion("stand", q, q, held, config, seen)
            plan_motion("way", q_via, q, held, config, seen)
        except UnsafeMotion:
            continue
        poses.append(T_camera_board)
        joints.append(q)
    return poses, joints


def _draw(held: HeldBoard, intrinsics: Intrinsics, rng: np.random.Generator, *, middle: bool = False) -> Array:
    """A T_camera_board: the board anywhere in the image (or in its middle, facing the camera), turned any way."""
    farthest = intrinsics.fx * held.board.square_m / _MIN_SQUARE_PX
    share = (0.4, 0.6) if middle else (_MARGIN, 1 - _MARGIN)
    u, v = rng.uniform(*share, 2) * (intrinsics.width, intrinsics.height)
    z = rng.uniform(_NEAREST_M, farthest)
    center = z * np.array([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, 1.0])
    axis = rng.uniform(0, 2 * np.pi)
    tilt = (0.0 if middle else rng.uniform(0, MAX_TILT_RAD)) * np.array([np.cos(axis), np.sin(axis), 0.0])
    R = (Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])).as_matrix()
    return make_transform(R, center - R @ held.center)


def _most_different(poses: list[Array], taken: list[Array], count: int) -> list[int]:
    """Indices of the poses that are, one after the other, farthest from all that were taken before."""
    stack = np.stack(poses)
    if taken:
        distance = np.min([_difference(stack, T) for T in taken], axis=0)
    else:
        # Begin with the most tilted: of two axes of rotation one is then there at once.
        distance = np.arccos(np.clip(stack[:, 2, 2], -1, 1))
    chosen: list[int] = []
    for _ in range(min(count, len(poses))):
        best = int(distance.argmax())
        new = _difference(stack, stack[best])
        distance = np.minimum(distance, new) if chosen or taken else new
        chosen.append(best)
    return chosen


def _difference(T: Array, T_reference: Array) -> Array:
    """How much (N,) poses (N, 4, 4) differ from one."""
    between = invert(T_reference[None]) @ T
    moved = np.linalg.norm(T[:, :3, 3] - T_reference[:3, 3], axis=1) / _FAR_M
    turned = np.linalg.norm(log(between[:, :3, :3]), axis=1) / _TURNED_RAD
    return np.asarray(np.hypot(moved, turned))


def _in_order(joints: list[Array], q_start: Array) -> list[Array]:
    """The nearest first, then the nearest to that one, and so on."""
    left, order, q = list(joints), [], q_start
    while left:
        q = left.pop(int(np.argmin([np.abs(other - q).max() for other in left])))
        order.append(q)
    return order


def _occluded(q: Array, held: HeldBoard, eye: Array) -> bool:
    """Whether the arm stands between the camera at `eye` (3,) and the board."""
    points = transform_points(ur5e.forward(q), held.points)
    moves_apart = bodies.SPHERES.link < FLANGE
    to_center = bodies.sphere_centers(q)[moves_apart] - eye
    sight = points - eye
    along = np.clip((to_center @ sight.T) / (sight**2).sum(axis=1), 0.0, 1.0)
    gaps = np.linalg.norm(to_center[:, None] - along[..., None] * sight, axis=-1)
    return bool((gaps < bodies.SPHERES.radius[moves_apart, None]).any())
