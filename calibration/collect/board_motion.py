"""Motions of the arm with the board: checked as every motion is, and for the plate as well.

The plate keeps clear of the arm, of the keep-outs, and of all that may stand on the table; of what is taller than that,
arm and plate keep clear by what the camera saw.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.surroundings import obstacles
from robotcell.errors import UnsafeMotion
from robotcell.geometry import bodies, ur5e
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import JointMove, MotionPlan
from robotcell.motion.tool import TALLEST_OBJECT_M

if TYPE_CHECKING:
    from calibration.target.held_board import HeldBoard
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.clearance_map import ClearanceMap

# Room around the plate for how differently it may be held.
_CLEARANCE_M = 0.015
# Whatever stands on the table stays there; board, gripper and wrists pass over it.
_ABOVE_TABLE_M = TALLEST_OBJECT_M + _CLEARANCE_M
# A plate that sways: slower than a job.
_JOINT_SPEED_RAD_S = 0.6
_ROUNDING_M = 0.002
# Indices of the first wrist and of the flange among the links of `bodies.Spheres`.
_WRISTS, FLANGE = 4, 6


def plan_motions(
    label: str,
    q_start: Array,
    q: Array,
    q_via: Array,
    held: HeldBoard,
    config: CellConfig,
    seen: ClearanceMap | None = None,
) -> list[CheckedPlan]:
    """The motions to joint angles (6,): straight there, or else through the via pose; see `plan_motion`.

    Raises:
        UnsafeMotion: neither is safe.
    """
    try:
        return [plan_motion(label, q_start, q, held, config, seen)]
    except UnsafeMotion:
        to_via = plan_motion(f"{label}, by way of the middle", q_start, q_via, held, config, seen)
        return [to_via, plan_motion(label, q_via, q, held, config, seen)]


def plan_motion(
    label: str, q_start: Array, q: Array, held: HeldBoard, config: CellConfig, seen: ClearanceMap | None = None
) -> CheckedPlan:
    """A joint-space motion with the board in the gripper, checked for arm, gripper and board.

    Args:
        label: of the motion, for errors.
        q_start: where it starts (6,) [rad].
        q: where it ends (6,) [rad].
        held: the board.
        config: of the cell.
        seen: what may stand on the table; None if nobody looked.

    Raises:
        UnsafeMotion: the first thing that stands in the way.
    """
    speed = min(_JOINT_SPEED_RAD_S, config.motion.joint_speed_rad_s)
    move = JointMove(label, q, speed, config.motion.joint_acceleration_rad_s2)
    checked = check_path(MotionPlan(label, q_start, (move,)), config, seen)
    # Where the arm stands now is a fact: only where it goes is checked.
    _check_board(checked.joint_paths[0][1:], held, config, label)
    if seen is not None:
        _check_clear(checked.joint_paths[0], held, seen, label)
    return checked


def _check_board(path: Array, held: HeldBoard, config: CellConfig, label: str) -> None:
    """Keep the plate clear of table, obstacles and arm along joint angles (N, 6)."""
    T_base_flange = ur5e.forward(path)
    points = np.einsum("nij,kj->nki", T_base_flange[:, :3, :3], held.points) + T_base_flange[:, None, :3, 3]
    centers = bodies.sphere_centers(path)
    wrists = bodies.SPHERES.link >= _WRISTS
    lowest = min(points[..., 2].min(), (centers[:, wrists, 2] - bodies.SPHERES.radius[wrists]).min())
    if lowest < config.table.height_m + _ABOVE_TABLE_M:
        raise UnsafeMotion(f"{label}: the board or the wrist would touch what may stand on the table")
    for box in obstacles(config):
        if bodies.box_distance(*box.corners(), points).min() < _CLEARANCE_M:
            raise UnsafeMotion(f"{label}: the board would enter the keep-out {box.name!r}")
    moves_apart = bodies.SPHERES.link < FLANGE
    gaps = (
        np.linalg.norm(points[:, :, None] - centers[:, None, moves_apart], axis=-1) - bodies.SPHERES.radius[moves_apart]
    )
    if gaps.min() < _CLEARANCE_M:
        raise UnsafeMotion(f"{label}: the board would touch the arm")


def _check_clear(path: Array, held: HeldBoard, seen: ClearanceMap, label: str) -> None:
    """Keep the plate clear of what stands higher than it may go, along joint angles (N, 6) from where it starts.

    A point of the plate that is too near to something at the start must not come nearer.
    """
    T_base_flange = ur5e.forward(path)
    points = np.einsum("nij,kj->nki", T_base_flange[:, :3, :3], held.points) + T_base_flange[:, None, :3, 3]
    flat = points.reshape(-1, 3)
    gaps = seen.gaps(flat, np.zeros(len(flat)), _ABOVE_TABLE_M, _CLEARANCE_M).reshape(points.shape[:2])
    if (gaps < np.minimum(_CLEARANCE_M, gaps[0]) - _ROUNDING_M).any():
        raise UnsafeMotion(f"{label}: the board would touch what the camera saw on the table")
