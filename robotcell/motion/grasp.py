"""A grasp from above: what the policy decides, and the motion that it becomes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.fingers import closed_width, narrowest_hold
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import rotation_angle
from robotcell.motion.plan import (
    CheckHold,
    Grip,
    MotionPlan,
    Shape,
    Step,
    blend_radius,
    guarded_move,
    joint_move,
    linear_move,
)
from robotcell.motion.rotations import ROTATIONS, rotation_angle_rad
from robotcell.motion.tool import flange_pose, near_height, solve_tool_down, tool_down, touch_height

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.perception.heightmap import Heightmap

# Paper, section "Evaluation" of the released code: the finger tips go 4 cm below the surface at the chosen pixel.
GRASP_DEPTH_M = 0.040
# A load gripped 4 cm below its top reaches at most this far below the tcp (the tallest block is 100 mm).
LOAD_REACH_M = 0.060
_TOP_NOISE_M = 0.010
# Label of the first check for a held object; one that passes here and fails later was lost on the way.
HELD_AFTER_LIFT = "held after the lift"
# Label of the second one; what passes here is let go into the bin next.
HELD_OVER_BIN = "held over the bin"
# A load is lifted until it would pass this high over the walls of the bin: they are seen up to 45 mm too high in places
# (measured in the twin), and 15 mm are kept from what is seen.
_CARRY_CLEARANCE_M = 0.05
# The finger tips are this high over the walls of the bin when they let go, the load beneath them likewise.
_BIN_CLEARANCE_M = 0.16
# An object falls freely, and the arm may leave, when the fingers have opened by this: 10 mm on either side.
_RELEASED_M = 0.020
# A flat block that was held 20 mm beside its middle slipped out of the fingers when it was turned by 1.2 rad on its
# way, and did not when it was turned by 0.7 or less (measured in the twin).
_LITTLE_TURN_RAD = 0.6
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


def above_grasp(grasp: Grasp, config: CellConfig) -> Array:
    """T_base_tcp (4, 4) from which the tool comes straight down for a grasp."""
    z = config.table.height_m + grasp_height(grasp.surface_m, config) + config.motion.approach_m
    return tool_down(grasp.x, grasp.y, z, grasp.theta)


def plan_grasp(
    grasp: Grasp, heightmap: Heightmap, q_start: Array, config: CellConfig, q_above: Array | None = None
) -> MotionPlan:
    """The motion of a grasp, from `q_start` (6,) [rad] to where the object is let go over the bin.

    From there the camera sees the whole workspace, and the next action may begin.

    Args:
        grasp: that was decided.
        heightmap: that it was decided on.
        q_start: where the arm stands.
        config: of the cell.
        q_above: joint angles (6,) [rad] above the grasp, from which the tool comes straight down and to which it is
            lifted at least; those to which the way is shortest at the approach height unless given.

    Raises:
        UnsafeMotion: a pose is out of reach.
    """
    table, use, motion = config.table.height_m, config.gripper, config.motion
    tcp_z = table + grasp_height(grasp.surface_m, config)
    approach_z = tcp_z + motion.approach_m
    load_m = load_reach(grasp, config)
    touch_m = touch_height(grasp.surface_m)
    top_z = approach_z
    if q_above is None:
        q_above = solve_tool_down("approach", above_grasp(grasp, config), config, q_start)
    else:
        top_z = float((ur5e.forward(q_above) @ rg2.T_FLANGE_TCP)[2, 3])
    # The symmetric jaw may have been turned by half a turn to stay near the home pose.
    T_above = ur5e.forward(q_above) @ rg2.T_FLANGE_TCP
    T_near, T_grasp, T_lifted = (T_above.copy() for _ in range(3))
    T_lifted[2, 3] = max(top_z, table + carry_height(config, load_m))
    if load_m > LOAD_REACH_M:
        # Over where the load itself stood, which the map of clearance still shows.
        T_lifted[2, 3] = max(T_lifted[2, 3], tcp_z + GRASP_DEPTH_M + load_m + _CARRY_CLEARANCE_M)
    T_near[2, 3] = near_height(heightmap, grasp.x, grasp.y, grasp.theta, use.preshape_m, tcp_z, config)
    T_grasp[2, 3] = tcp_z
    q_lifted = ur5e.inverse(flange_pose(T_lifted), q_above)
    steps: tuple[Step, ...] = (
        Shape("pre-shape", use.preshape_m, use.force_n),
        joint_move("approach", q_above, config, blend_m=blend_radius(top_z - T_near[2, 3])),
        # It ends above all that is under the fingers; what they pass beside is the business of who decided.
        linear_move("descend", T_near, config, touch_m=touch_m),
        guarded_move("descend guarded", T_grasp, config, touch_m),
        Grip("close", closed_width(config), use.force_n, motion.closing_force_n),
        linear_move("lift", T_lifted, config, load_m, touch_m, blend_radius(T_lifted[2, 3] - tcp_z)),
        CheckHold(HELD_AFTER_LIFT, narrowest_hold(config)),
        *_carry(grasp, q_above if q_lifted is None else q_lifted, config),
    )
    return MotionPlan("grasp", q_start, steps)


def plan_carry(grasp: Grasp, q_start: Array, config: CellConfig) -> MotionPlan:
    """The last part of a grasp's motion, from `q_start` (6,) [rad] where what it took is held high enough already.

    Raises:
        UnsafeMotion: a pose is out of reach.
    """
    return MotionPlan("carry", q_start, _carry(grasp, q_start, config))


def load_reach(grasp: Grasp, config: CellConfig) -> float:
    """How far below the tcp [m] what a grasp takes reaches at most: down to the table that it stands on."""
    reach = grasp_height(grasp.surface_m, config)
    # The top of the tallest block is seen some millimetres too high at times.
    return reach if reach > LOAD_REACH_M + _TOP_NOISE_M else LOAD_REACH_M


def carry_height(config: CellConfig, load_m: float = LOAD_REACH_M) -> float:
    """Height of the tcp above the table [m] from which on a load passes over the walls of the bin."""
    return config.bin.wall_height_m + load_m + _CARRY_CLEARANCE_M


def _carry(grasp: Grasp, q_from: Array, config: CellConfig) -> tuple[Step, ...]:
    """From joint angles (6,) near `q_from` [rad] over the bin, and let go there."""
    use = config.gripper
    bin_x, bin_y = _release_point(grasp.x, grasp.y, config)
    load_m = load_reach(grasp, config)
    bin_z = config.table.height_m + config.bin.wall_height_m + _BIN_CLEARANCE_M + load_m - LOAD_REACH_M
    return (
        joint_move("carry to bin", _over_bin((bin_x, bin_y, bin_z), q_from, config), config, load_m),
        CheckHold(HELD_OVER_BIN, narrowest_hold(config)),
        Shape("release", use.preshape_m, use.force_n, _RELEASED_M),
    )


def _over_bin(place: tuple[float, float, float], q_from: Array, config: CellConfig) -> Array:
    """Joint angles (6,) [rad] with the tcp at a place over the bin, turned so that the way there is the shortest.

    Args:
        place: (x, y, z) of the tcp, base frame [m].
        q_from: joint angles (6,) where the way begins.
        config: of the cell.

    Raises:
        UnsafeMotion: the place is out of reach.
    """
    # How an object lies in the bin does not matter; the jaw repeats itself after half a turn.
    poses = [tool_down(*place, rotation_angle_rad(k)) for k in range(ROTATIONS // 2)]
    turns = [solve_tool_down("carry to bin", T, config, q_from) for T in poses]
    # Of equal ways, one on which the load turns little, and of those the one that ends nearest to home.
    home, R_from = np.array(config.motion.home_q), ur5e.forward(q_from)[:3, :3]

    def cost(q: Array) -> tuple[float, float, float]:
        turn = rotation_angle(R_from, ur5e.forward(q)[:3, :3])
        away = float(np.abs(q - home).max())
        return round(float(np.abs(q - q_from).max()), 2), round(max(turn - _LITTLE_TURN_RAD, 0.0), 2), away

    return min(turns, key=cost)


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
