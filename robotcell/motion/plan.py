"""From an action to a motion plan: what the arm and the gripper will do, step by step.

A plan is data. Nothing here moves, and nothing here decides whether the plan is safe: `safety.check_plan` does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import Array, invert_transform, make_transform
from robotcell.jobs.policy_api import Action, Primitive

if TYPE_CHECKING:
    from robotcell.config.schema import CellConfig
    from robotcell.interfaces import ArmState
    from robotcell.perception.heightmap import Heightmap

# Paper, section "Evaluation" of the released code: the finger tips go 4 cm below the surface at the chosen pixel.
GRASP_DEPTH_M = 0.040
# A load gripped 4 cm below its top reaches at most this far below the tcp (the tallest block is 100 mm).
LOAD_REACH_M = 0.060
# What the camera did not see may be as tall as the tallest block.
TALLEST_OBJECT_M = 0.100
# The gripper is taken to be this much larger all round, for what it comes down beside.
_AROUND_M = 0.004
# Label of the first check for a held object; one that passes here and fails later was lost on the way.
HELD_AFTER_LIFT = "held after the lift"
# The unguarded part of a descent ends this far above the highest thing under the open gripper.
_NEAR_M = 0.015
# A load is lifted until it would pass this high over the walls of the bin.
_CARRY_CLEARANCE_M = 0.03
# The finger tips are this high over the walls of the bin when they let go.
_BIN_CLEARANCE_M = 0.12
# Share of the bin's sides over which objects are let go; what is left is room for their own size.
_RELEASE_SHARE = 0.5
# A direction whose component along a side of the workspace is smaller never crosses the other one.
_PARALLEL = 1e-9
# A push shorter than this, after it was clamped to the workspace, moves nothing.
_MIN_PUSH_M = 0.02


@dataclass(frozen=True)
class JointMove:
    """A joint-space motion to q (6,) [rad]; `load_m` is how far a held object reaches below the tcp."""

    label: str
    q: Array
    speed_rad_s: float
    acceleration_rad_s2: float
    load_m: float = 0.0


@dataclass(frozen=True)
class LinearMove:
    """A straight motion of the tcp to `T_base_tcp`.

    With `contact_force_n` the motion is guarded: that force ends the plan with `Ending.CONTACT`.
    """

    label: str
    T_base_tcp: Array
    speed_m_s: float
    acceleration_m_s2: float
    contact_force_n: float | None = None
    load_m: float = 0.0


@dataclass(frozen=True)
class Grip:
    """A motion of the fingers, waited for.

    Where the arm feels more than `contact_force_n` meanwhile, the fingers go back to where they were, and the plan ends
    with `Ending.CONTACT`.
    """

    label: str
    width_m: float
    force_n: float
    contact_force_n: float | None = None


@dataclass(frozen=True)
class CheckHold:
    """Ends the plan with `Ending.EMPTY` unless the fingers hold something at least this wide."""

    label: str
    min_width_m: float


Step: TypeAlias = JointMove | LinearMove | Grip | CheckHold


@dataclass(frozen=True)
class MotionPlan:
    """Steps that start from the joint angles `q_start` (6,) [rad]."""

    label: str
    q_start: Array
    steps: tuple[Step, ...]


def tool_down(x: float, y: float, z: float, theta: float) -> Array:
    """T_base_tcp (4, 4) of a tool that points straight down and closes along (cos theta, sin theta)."""
    c, s = math.cos(theta), math.sin(theta)
    return make_transform([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]], (x, y, z))


def flange_pose(T_base_tcp: Array) -> Array:
    """T_base_flange (..., 4, 4) of tcp poses."""
    return T_base_tcp @ invert_transform(rg2.T_FLANGE_TCP)


def plan_action(action: Action, heightmap: Heightmap, q_start: Array, config: CellConfig) -> MotionPlan:
    """The motion of a grasp or a push, from `q_start` back to the home pose.

    Raises:
        UnsafeMotion: a pose is out of reach, or nothing is left of a push inside the workspace.
    """
    if action.primitive is Primitive.GRASP:
        return _plan_grasp(action, heightmap, q_start, config)
    return _plan_push(action, heightmap, q_start, config)


def plan_retreat(state: ArmState, config: CellConfig) -> MotionPlan:
    """Straight up to the approach height, open the fingers, go home: from wherever the arm stands."""
    clear_z = config.table.height_m + config.motion.approach_m + GRASP_DEPTH_M
    steps: list[Step] = []
    if state.T_base_tcp[2, 3] < clear_z:
        T_up = state.T_base_tcp.copy()
        T_up[2, 3] = clear_z
        steps.append(_linear("retreat", T_up, config))
    steps.append(Grip("open", config.gripper.preshape_m, config.gripper.force_n))
    steps.append(_home(config))
    return MotionPlan("retreat", state.q, tuple(steps))


def push_segment(action: Action, config: CellConfig) -> tuple[tuple[float, float], tuple[float, float]]:
    """Start and end (x, y) [m] of a push: the start clamped to the workspace, the way cut off where it leaves it."""
    workspace = config.workspace
    start = [min(max(v, low), high) for v, (low, high) in zip(action.xyz, (workspace.x, workspace.y), strict=False)]
    direction = (math.cos(action.theta), math.sin(action.theta))
    length = config.motion.push_m
    for v, d, (low, high) in zip(start, direction, (workspace.x, workspace.y), strict=True):
        if abs(d) > _PARALLEL:
            length = min(length, ((high if d > 0 else low) - v) / d)
    x, y = start
    return (x, y), (x + length * direction[0], y + length * direction[1])


def grasp_height(surface_m: float, config: CellConfig) -> float:
    """Height of the tcp above the table [m] for a grasp at a surface that high."""
    return max(surface_m - GRASP_DEPTH_M, config.gripper.tip_clearance_m)


def push_height(surface_m: float, config: CellConfig) -> float:
    """Height of the tcp above the table [m] for a push of a surface that high: half of it (paper)."""
    return max(surface_m / 2, config.gripper.tip_clearance_m)


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
    highest = config.table.height_m + _clear_above(heightmap, x, y, theta, opening_m)
    near = highest + _NEAR_M - rg2.tip_retraction(opening_m)
    return float(np.clip(near, tcp_z, tcp_z + config.motion.approach_m))


def _plan_grasp(action: Action, heightmap: Heightmap, q_start: Array, config: CellConfig) -> MotionPlan:
    table, use, motion = config.table.height_m, config.gripper, config.motion
    x, y, z = action.xyz
    tcp_z = table + grasp_height(z - table, config)
    approach_z = tcp_z + motion.approach_m
    theta = action.theta
    q_above = _solve("approach", tool_down(x, y, approach_z, theta), config)
    # The symmetric jaw may have been turned by half a turn to stay near the home pose.
    T_above = ur5e.forward(q_above) @ rg2.T_FLANGE_TCP
    T_near, T_grasp, T_lifted = (T_above.copy() for _ in range(3))
    T_lifted[2, 3] = max(approach_z, table + config.bin.wall_height_m + LOAD_REACH_M + _CARRY_CLEARANCE_M)
    T_near[2, 3] = near_height(heightmap, x, y, theta, use.preshape_m, tcp_z, config)
    T_grasp[2, 3] = tcp_z
    bin_x, bin_y = _release_point(x, y, config)
    bin_z = table + config.bin.wall_height_m + _BIN_CLEARANCE_M
    q_bin = _solve("carry to bin", tool_down(bin_x, bin_y, bin_z, 0.0), config)
    steps: tuple[Step, ...] = (
        Grip("pre-shape", use.preshape_m, use.force_n),
        _joint("approach", q_above, config),
        _linear("descend", T_near, config),
        LinearMove(
            "descend guarded",
            T_grasp,
            motion.guarded_speed_m_s,
            motion.linear_acceleration_m_s2,
            contact_force_n=motion.contact_force_n,
        ),
        Grip("close", rg2.MIN_WIDTH_M, use.force_n, motion.closing_force_n),
        LinearMove("lift", T_lifted, motion.linear_speed_m_s, motion.linear_acceleration_m_s2, load_m=LOAD_REACH_M),
        CheckHold(HELD_AFTER_LIFT, use.empty_width_m),
        _joint("carry to bin", q_bin, config, load_m=LOAD_REACH_M),
        CheckHold("held over the bin", use.empty_width_m),
        Grip("release", use.preshape_m, use.force_n),
        _home(config),
    )
    return MotionPlan("grasp", q_start, steps)


def _release_point(x: float, y: float, config: CellConfig) -> tuple[float, float]:
    """Where (x, y) [m] over the bin a grasp at (x, y) lets go: the workspace shrunk onto the middle of the bin.

    Objects that were spread over the table are then spread over the bin instead of heaped up at one point.
    """
    fractions = ((v - a) / (b - a) - 0.5 for v, (a, b) in ((x, config.workspace.x), (y, config.workspace.y)))
    bin_x, bin_y = (
        center + _RELEASE_SHARE * side * min(max(f, -0.5), 0.5)
        for center, side, f in zip(config.bin.center, config.bin.size, fractions, strict=True)
    )
    return bin_x, bin_y


def _plan_push(action: Action, heightmap: Heightmap, q_start: Array, config: CellConfig) -> MotionPlan:
    table, motion = config.table.height_m, config.motion
    (x, y), (end_x, end_y) = push_segment(action, config)
    if math.hypot(end_x - x, end_y - y) < _MIN_PUSH_M:
        raise UnsafeMotion(
            f"push at x {x:.3f}, y {y:.3f} m: less than {1000 * _MIN_PUSH_M:.0f} mm of it is inside the workspace"
        )
    tcp_z = table + push_height(action.xyz[2] - table, config)
    approach_z = tcp_z + motion.approach_m
    q_above = _solve("approach", tool_down(x, y, approach_z, action.theta), config)
    T_above = ur5e.forward(q_above) @ rg2.T_FLANGE_TCP
    T_near, T_start, T_end, T_up = (T_above.copy() for _ in range(4))
    T_near[2, 3] = near_height(heightmap, x, y, action.theta, rg2.MIN_WIDTH_M, tcp_z, config)
    T_start[2, 3] = tcp_z
    T_end[:3, 3] = (end_x, end_y, tcp_z)
    T_up[:3, 3] = (end_x, end_y, approach_z)
    guarded = {
        "speed_m_s": motion.guarded_speed_m_s,
        "acceleration_m_s2": motion.linear_acceleration_m_s2,
        "contact_force_n": motion.contact_force_n,
    }
    steps: tuple[Step, ...] = (
        Grip("close", rg2.MIN_WIDTH_M, config.gripper.force_n),
        _joint("approach", q_above, config),
        _linear("descend", T_near, config),
        LinearMove("descend guarded", T_start, **guarded),
        LinearMove("push", T_end, **guarded),
        _linear("lift", T_up, config),
        _home(config),
    )
    return MotionPlan("push", q_start, steps)


def _clear_above(heightmap: Heightmap, x: float, y: float, theta: float, opening_m: float) -> float:
    """Height [m above the table] above which nothing is expected under the gripper, turned by theta and so far open.

    The highest cell that was seen there; where a cell is unknown, or lies outside the map, at least the tallest
    object. Gaps between pixels are closed first.
    """
    workspace = heightmap.workspace
    half_x = opening_m / 2 + rg2.FINGER_THICKNESS_M + _AROUND_M
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


def _solve(label: str, T_base_tcp: Array, config: CellConfig) -> Array:
    """Joint angles nearest to the home pose; the jaw is symmetric, so half a turn about its axis is as good."""
    home = np.array(config.motion.home_q)
    poses = (T_base_tcp, T_base_tcp @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    solutions = [q for T in poses if (q := ur5e.inverse(flange_pose(T), home)) is not None]
    if not solutions:
        x, y, z = T_base_tcp[:3, 3]
        raise UnsafeMotion(f"{label}: the arm cannot reach x {x:.3f}, y {y:.3f}, z {z:.3f} m with the tool down")
    return min(solutions, key=lambda q: float(np.abs(q - home).max()))


def _joint(label: str, q: Array, config: CellConfig, load_m: float = 0.0) -> JointMove:
    return JointMove(label, q, config.motion.joint_speed_rad_s, config.motion.joint_acceleration_rad_s2, load_m)


def _linear(label: str, T_base_tcp: Array, config: CellConfig) -> LinearMove:
    return LinearMove(label, T_base_tcp, config.motion.linear_speed_m_s, config.motion.linear_acceleration_m_s2)


def _home(config: CellConfig) -> JointMove:
    return _joint("home", np.array(config.motion.home_q), config)
