"""The tool that points straight down: its poses, how the arm reaches them, and how far it may come down unguarded."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.fingers import gripper_range
from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import Array, invert_transform, make_transform
from robotcell.perception.clearance_map import TALLEST_BLOCK_M

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.perception.heightmap import Heightmap

# What the camera did not see may be as tall as the tallest block.
TALLEST_OBJECT_M = TALLEST_BLOCK_M
# Where contact is meant, fingers may touch what lies in a heap of blocks, or is not much taller than what is grasped:
# the map of clearance rounds up.
HEAP_M, _TOUCH_MARGIN_M = 0.180, 0.020
# The gripper is taken to be this much larger all round, for what it comes down beside.
_AROUND_M = 0.004
# The unguarded part of a descent ends this far above the highest thing under the open gripper.
_NEAR_M = 0.015


def tool_down(x: float, y: float, z: float, theta: float) -> Array:
    """T_base_tcp (4, 4) of a tool that points straight down and closes along (cos theta, sin theta)."""
    c, s = math.cos(theta), math.sin(theta)
    return make_transform([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]], (x, y, z))


def flange_pose(T_base_tcp: Array) -> Array:
    """T_base_flange (..., 4, 4) of tcp poses."""
    return T_base_tcp @ invert_transform(rg2.T_FLANGE_TCP)


def solve_tool_down(label: str, T_base_tcp: Array, config: CellConfig, q_from: Array | None = None) -> Array:
    """Joint angles (6,) [rad] in the posture of the home pose.

    The jaw is symmetric, so half a turn about its axis is as good.

    Args:
        label: of the step, for the error.
        T_base_tcp: pose (4, 4) of a tool that points down.
        config: of the cell.
        q_from: joint angles (6,) from which the leading joint is to have the shortest way; the home pose unless given.

    Raises:
        UnsafeMotion: the arm cannot reach the pose.
    """
    home = np.array(config.motion.home_q)
    poses = (T_base_tcp, T_base_tcp @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    solutions = [q for T in poses if (q := ur5e.inverse(flange_pose(T), home)) is not None]
    if not solutions:
        x, y, z = T_base_tcp[:3, 3]
        raise UnsafeMotion(f"{label}: the arm cannot reach x {x:.3f}, y {y:.3f}, z {z:.3f} m with the tool down")
    near = home if q_from is None else q_from
    return min(solutions, key=lambda q: float(np.abs(q - near).max()))


def tool_down_solutions(T_base_tcp: Array, config: CellConfig) -> list[Array]:
    """All joint angles (6,) [rad] for a pose as in `solve_tool_down`, those nearest to the home pose first.

    They differ in the turns of the wrist, in where the elbow is and to which side the shoulder turns.
    """
    home = np.array(config.motion.home_q)
    poses = (T_base_tcp, T_base_tcp @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    solutions = np.concatenate([ur5e.inverse_all(flange_pose(T), home) for T in poses])
    return sorted(solutions, key=lambda q: float(np.abs(q - home).max()))


def touch_height(top_m: float) -> float:
    """Height above the table [m] up to which things may be touched where something with that top is meant."""
    return max(HEAP_M, top_m + _TOUCH_MARGIN_M)


def near_height(
    heightmap: Heightmap, x: float, y: float, theta: float, opening_m: float, tcp_z: float, config: CellConfig
) -> float:
    """The z of the tcp [m] at which the guarded part of a descent to `tcp_z` begins.

    Args:
        heightmap: what is known of the surroundings.
        x: where the tool comes down [m].
        y: likewise.
        theta: how the tool is turned about base z [rad].
        opening_m: of the fingers, whose tips draw back as they open.
        tcp_z: z of the tcp at the end of the descent [m].
        config: of the cell.
    """
    offset_m = gripper_range(config).fingertip_offset_m
    thickness = rg2.finger_thickness(offset_m)
    highest = config.table.height_m + _clear_above(heightmap, x, y, theta, opening_m, thickness)
    near = highest + _NEAR_M - rg2.tip_retraction(opening_m, offset_m)
    return float(np.clip(near, tcp_z, tcp_z + config.motion.approach_m))


def _clear_above(heightmap: Heightmap, x: float, y: float, theta: float, opening_m: float, thickness_m: float) -> float:
    """Height [m above the table] above which nothing is expected under the gripper, turned by theta and so far open.

    The highest cell that was seen there; where a cell is unknown, or lies outside the map, at least the tallest
    object. Gaps between pixels are closed first.
    """
    workspace = heightmap.workspace
    half_x = opening_m / 2 + thickness_m + _AROUND_M
    half_y = rg2.FINGER_BREADTH_M / 2 + _AROUND_M
    steps = [np.arange(-half, half + workspace.resolution_m, workspace.resolution_m) for half in (half_x, half_y)]
    u, v = np.meshgrid(*steps)
    col = np.floor((x + u * math.cos(theta) - v * math.sin(theta) - workspace.x[0]) / workspace.resolution_m)
    row = np.floor((y + u * math.sin(theta) + v * math.cos(theta) - workspace.y[0]) / workspace.resolution_m)
    rows, cols = workspace.shape
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    heights = heightmap.closed_m[row[inside].astype(np.intp), col[inside].astype(np.intp)]
    seen = heights[np.isfinite(heights)]
    highest = max(0.0, float(seen.max())) if seen.size else 0.0
    return highest if inside.all() and seen.size == heights.size else max(highest, TALLEST_OBJECT_M)
