"""A push with the closed fingers: what the policy decides, and the motion that it becomes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotcell.config.fingers import closed_width
from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.motion.plan import (
    MotionPlan,
    Shape,
    Step,
    blend_radius,
    guarded_move,
    home_move,
    joint_move,
    linear_move,
)
from robotcell.motion.rotations import rotation_angle_rad
from robotcell.motion.tool import near_height, solve_tool_down, tool_down, touch_height

if TYPE_CHECKING:
    from robotcell.config import CellConfig, Workspace
    from robotcell.geometry.transforms import Array
    from robotcell.perception.heightmap import Heightmap

# A direction whose component along a side of the workspace is smaller never crosses the other one.
_PARALLEL = 1e-9
# A push shorter than this, after it was cut off at the rim of the workspace, moves nothing.
_MIN_PUSH_M = 0.02


@dataclass(frozen=True)
class Push:
    """A decision to push.

    Attributes:
        start: (x, y) where the closed fingers come down, base frame [m].
        end: (x, y) where they are lifted again, base frame [m].
        rotation: index k; they move along (cos theta, sin theta) with theta = k * 22.5 degrees about base z.
        top_m: height above the table [m] of the top of what they meet first.
        q_value: what the policy expects of it; comparable only within one policy.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    rotation: int
    top_m: float
    q_value: float

    @property
    def theta(self) -> float:
        """The direction about base z [rad]."""
        return rotation_angle_rad(self.rotation)

    @property
    def length_m(self) -> float:
        """How far the fingers move [m]."""
        return math.dist(self.start, self.end)


def push_in_workspace(
    start: tuple[float, float], rotation: int, length_m: float, top_m: float, q_value: float, workspace: Workspace
) -> Push:
    """The push of a length from a start, cut off where it leaves the workspace; a start beside it is moved to its rim.

    Args:
        start: (x, y) where the fingers come down, base frame [m].
        rotation: index of its direction, see `Push`.
        length_m: at most [m].
        top_m: see `Push`.
        q_value: see `Push`.
        workspace: that it stays in.
    """
    x, y = (min(max(v, low), high) for v, (low, high) in zip(start, (workspace.x, workspace.y), strict=True))
    direction = (math.cos(rotation_angle_rad(rotation)), math.sin(rotation_angle_rad(rotation)))
    for v, d, (low, high) in zip((x, y), direction, (workspace.x, workspace.y), strict=True):
        if abs(d) > _PARALLEL:
            length_m = min(length_m, ((high if d > 0 else low) - v) / d)
    end = (x + length_m * direction[0], y + length_m * direction[1])
    return Push((x, y), end, rotation, top_m, q_value)


def push_height(top_m: float, config: CellConfig) -> float:
    """Height of the tcp above the table [m] for a push of what is that high: half of it (paper)."""
    return max(top_m / 2, config.gripper.tip_clearance_m)


def above_push(push: Push, config: CellConfig) -> Array:
    """T_base_tcp (4, 4) from which the tool comes straight down for a push."""
    z = config.table.height_m + push_height(push.top_m, config) + config.motion.approach_m
    return tool_down(*push.start, z, push.theta)


def plan_push(
    push: Push, heightmap: Heightmap, q_start: Array, config: CellConfig, q_above: Array | None = None
) -> MotionPlan:
    """The motion of a push, from `q_start` (6,) [rad] back to the home pose.

    Args:
        push: that was decided.
        heightmap: that it was decided on.
        q_start: where the arm stands.
        config: of the cell.
        q_above: joint angles (6,) [rad] above its start, from which the tool comes straight down and to whose height
            it is lifted; those nearest to the home pose at the approach height unless given.

    Raises:
        UnsafeMotion: a pose is out of reach, or the push is too short to move anything.
    """
    (x, y), (end_x, end_y) = push.start, push.end
    if push.length_m < _MIN_PUSH_M:
        raise UnsafeMotion(
            f"push at x {x:.3f}, y {y:.3f} m: less than {1000 * _MIN_PUSH_M:.0f} mm of it is inside the workspace"
        )
    tcp_z = config.table.height_m + push_height(push.top_m, config)
    approach_z = tcp_z + config.motion.approach_m
    touch_m = touch_height(push.top_m)
    top_z = approach_z
    if q_above is None:
        q_above = solve_tool_down("approach", above_push(push, config), config, q_start)
    else:
        top_z = float((ur5e.forward(q_above) @ rg2.T_FLANGE_TCP)[2, 3])
    T_above = ur5e.forward(q_above) @ rg2.T_FLANGE_TCP
    T_near, T_start, T_end, T_up = (T_above.copy() for _ in range(4))
    T_near[2, 3] = near_height(heightmap, x, y, push.theta, closed_width(config), tcp_z, config)
    T_start[2, 3] = tcp_z
    T_end[:3, 3] = (end_x, end_y, tcp_z)
    T_up[:3, 3] = (end_x, end_y, top_z)
    steps: tuple[Step, ...] = (
        Shape("close", closed_width(config), config.gripper.force_n),
        joint_move("approach", q_above, config, blend_m=blend_radius(top_z - T_near[2, 3])),
        linear_move("descend", T_near, config, touch_m=touch_m),
        guarded_move("descend guarded", T_start, config, touch_m),
        guarded_move("push", T_end, config, touch_m),
        linear_move("lift", T_up, config, touch_m=touch_m, blend_m=blend_radius(top_z - tcp_z)),
        home_move(config),
    )
    return MotionPlan("push", q_start, steps)
