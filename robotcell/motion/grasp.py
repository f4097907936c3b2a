"""A grasp from above: what the policy decides, and the motion that it becomes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

from robotcell.config.fingers import closed_width, narrowest_hold
from robotcell.geometry import rg2, ur5e
from robotcell.motion.plan import (
    CheckHold,
    Grip,
    LinearMove,
    MotionPlan,
    Step,
    guarded_move,
    home_move,
    joint_move,
    linear_move,
)
from robotcell.motion.rotations import rotation_angle_rad
from robotcell.motion.tool import near_height, solve_tool_down, tool_down

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.perception.heightmap import Heightmap

# Paper, section "Evaluation" of the released code: the finger tips go 4 cm below the surface at the chosen pixel.
GRASP_DEPTH_M = 0.040
# A load gripped 4 cm below its top reaches at most this far below the tcp (the tallest block is 100 mm).
LOAD_REACH_M = 0.060
# Label of the first check for a held object; one that passes here and fails later was lost on the way.
HELD_AFTER_LIFT = "held after the lift"
# A load is lifted until it would pass this high over the walls of the bin.
_CARRY_CLEARANCE_M = 0.03
# The finger tips are this high over the walls of the bin when they let go.
_BIN_CLEARANCE_M = 0.12
# Share of the bin's sides over which objects are let go; what is left is room for their own size.
_RELEASE_SHARE = 0.5


@dataclass(frozen=True)
class Grasp:
    """A decision to grasp.

    Attributes:
        x, y: middle between the fingers, base frame [m].
        surface_m: height of the surface there above the table [m].
        rotation: index k; the fingers close along (cos theta, sin theta) with theta = k * 22.5 degrees about base z.
        q_value: what the policy expects of it; comparable only within one policy.
    """

    x: float
    y: float
    surface_m: float
    rotation: int
    q_value: float

    @property
    def theta(self) -> float:
        """The closing direction about base z [rad]."""
        return rotation_angle_rad(self.rotation)


def grasp_height(surface_m: float, config: CellConfig) -> float:
    """Height of the tcp above the table [m] for a grasp at a surface that high."""
    return max(surface_m - GRASP_DEPTH_M, config.gripper.tip_clearance_m)


def plan_grasp(grasp: Grasp, heightmap: Heightmap, q_start: Array, config: CellConfig) -> MotionPlan:
    """The motion of a grasp, from `q_start` (6,) [rad] over the bin back to the home pose.

    Raises:
        UnsafeMotion: a pose is out of reach.
    """
    table, use, motion = config.table.height_m, config.gripper, config.motion
    holds_m = narrowest_hold(config)
    tcp_z = table + grasp_height(grasp.surface_m, config)
    approach_z = tcp_z + motion.approach_m
    q_above = solve_tool_down("approach", tool_down(grasp.x, grasp.y, approach_z, grasp.theta), config)
    # The symmetric jaw may have been turned by half a turn to stay near the home pose.
    T_above = ur5e.forward(q_above) @ rg2.T_FLANGE_TCP
    T_near, T_grasp, T_lifted = (T_above.copy() for _ in range(3))
    T_lifted[2, 3] = max(approach_z, table + config.bin.wall_height_m + LOAD_REACH_M + _CARRY_CLEARANCE_M)
    T_near[2, 3] = near_height(heightmap, grasp.x, grasp.y, grasp.theta, use.preshape_m, tcp_z, config)
    T_grasp[2, 3] = tcp_z
    bin_x, bin_y = _release_point(grasp.x, grasp.y, config)
    bin_z = table + config.bin.wall_height_m + _BIN_CLEARANCE_M
    q_bin = solve_tool_down("carry to bin", tool_down(bin_x, bin_y, bin_z, 0.0), config)
    steps: tuple[Step, ...] = (
        Grip("pre-shape", use.preshape_m, use.force_n),
        joint_move("approach", q_above, config),
        linear_move("descend", T_near, config),
        guarded_move("descend guarded", T_grasp, config),
        Grip("close", closed_width(config), use.force_n, motion.closing_force_n),
        LinearMove("lift", T_lifted, motion.linear_speed_m_s, motion.linear_acceleration_m_s2, load_m=LOAD_REACH_M),
        CheckHold(HELD_AFTER_LIFT, holds_m),
        joint_move("carry to bin", q_bin, config, load_m=LOAD_REACH_M),
        CheckHold("held over the bin", holds_m),
        Grip("release", use.preshape_m, use.force_n),
        home_move(config),
    )
    return MotionPlan("grasp", q_start, steps)


def release_corners(config: CellConfig) -> tuple[tuple[float, float, float], ...]:
    """Where (x, y, z) [m] the tcp goes over the bin: the farthest points at which a grasp lets go."""
    z = config.table.height_m + config.bin.wall_height_m + _BIN_CLEARANCE_M
    return tuple((*_release_point(x, y, config), z) for x, y in product(config.workspace.x, config.workspace.y))


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
