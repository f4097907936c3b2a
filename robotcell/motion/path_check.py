"""The check of a whole plan before anything moves: the arm's path is sampled once, and the samples go with the plan.

It adds to the safety settings of the controller and never replaces them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.config.fingers import gripper_range, with_tips
from robotcell.config.surroundings import obstacles
from robotcell.errors import UnsafeMotion
from robotcell.geometry import bodies, rg2, ur5e
from robotcell.geometry.rounded_path import round_corners
from robotcell.geometry.transforms import Array, check_transform, interpolate_transforms, rotation_angle
from robotcell.motion.clearance import Tool, check_clearance
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove, MotionPlan, Shape, blended, is_guarded
from robotcell.motion.tool import HEAP_M, flange_pose

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from robotcell.config import CellConfig, KeepOut
    from robotcell.interfaces import GripperRange
    from robotcell.motion.plan import Step
    from robotcell.perception.clearance_map import ClearanceMap

# Distance between the samples of a checked path. A joint step of 0.04 rad moves the outstretched tcp by 40 mm.
_JOINT_STEP_RAD = 0.04
_LINEAR_STEP_M = 0.01
_ROTATION_STEP_RAD = 0.05
# On a rounded corner, which is short: the radius is a few centimetres.
_CORNER_SAMPLES = 9
# Two neighbouring samples of a straight path whose joints differ by more lie across a singularity.
_MAX_JOINT_JUMP_RAD = 0.35
# Rounding of positions that lie on a limit.
_ROUNDING_M = 1e-6
# The base and the turning shoulder stand on the table, or in it where the table is higher than the arm's base.
_STANDS_ON_TABLE = 2


@dataclass(frozen=True)
class CheckedPlan:
    """A plan that `check_path` found safe; the only thing that the executor accepts.

    Attributes:
        plan: as it was checked.
        joint_paths: for each step the joint angles (N, 6) [rad] along it, from its start to its end, or from the middle
            of a rounded corner to the middle of the next one; (1, 6) for a step that moves no joint.
        lowest_tip_m: height above the table that the finger tips may go down to [m].
    """

    plan: MotionPlan
    joint_paths: tuple[Array, ...]
    lowest_tip_m: float


def check_path(
    plan: MotionPlan, config: CellConfig, seen: ClearanceMap | None = None, *, lowest_tip_m: float | None = None
) -> CheckedPlan:
    """Check every step of a plan against every limit, from the joint angles it starts at.

    Reach, joint limits, singularities on straight lines, speeds, the box of the tcp, keep-outs, the table, the arm
    itself and the gripper's range; with the load where one is held; and what the camera saw. Where the arm stands at
    the start is a fact, not a plan: only where it goes is checked, so that it can leave a place that it should not be
    in.

    Args:
        plan: to be checked.
        config: of the cell, with its limits.
        seen: what may stand on the table; without it nobody looked, and only furniture is known.
        lowest_tip_m: height above the table that the finger tips may go down to [m], below it where negative;
            gripper.tip_clearance_m of the cell unless given.

    Raises:
        Obstructed: something that the camera saw, or may have overlooked, stands in the way.
        UnsafeMotion: the first other violation, with the step, the place and the limit.
    """
    lowest = config.gripper.tip_clearance_m if lowest_tip_m is None else lowest_tip_m
    q = _joint_vector(plan.q_start, f"{plan.label}: start")
    paths: list[Array] = []
    with_tools = tools(plan)
    for group in blended(plan.steps):
        legs: dict[int, Array] = {}
        for i in group:
            legs[i] = _leg(q, plan.steps[i], config, f"{plan.label}, step {plan.steps[i].label!r}")
            q = legs[i][-1]
        for i, path in _rounded(legs, plan).items():
            name = f"{plan.label}, step {plan.steps[i].label!r}"
            # An arm that does not round a corner comes to the corner itself.
            _check_driven(path, legs[i][-1:], plan.steps[i], with_tools[i], config, seen, name, lowest)
            paths.append(path)
    return CheckedPlan(plan, tuple(paths), lowest)


def check_step(
    q: Array, step: Step, tool: Tool, config: CellConfig, seen: ClearanceMap | None, name: str, lowest_tip_m: float
) -> Array:
    """Joint angles (N, 6) [rad] along one step from q (6,) to its target, checked as `check_path` does.

    Args:
        q: where it starts.
        step: to be checked; its corners are not rounded.
        tool: on the flange meanwhile.
        config: of the cell.
        seen: what may stand on the table; None if nobody looked.
        name: of the step, for the error.
        lowest_tip_m: height above the table that the finger tips may go down to.

    Raises:
        UnsafeMotion: as `check_path`.
    """
    path = _leg(q, step, config, name)
    _check_driven(path, path[-1:], step, tool, config, seen, name, lowest_tip_m)
    return path


def _leg(q: Array, step: Step, config: CellConfig, name: str) -> Array:
    """Joint angles (N, 6) along one step from q (6,); (1, 6) where the arm stands. Speeds and ranges are checked."""
    if isinstance(step, Grip | Shape):
        _check_grip(step, gripper_range(config), name)
        return q[None]
    if isinstance(step, CheckHold):
        return q[None]
    if isinstance(step, JointMove):
        return joint_path(q, step, config, name)
    if isinstance(step, LinearMove):
        return linear_path(q, step, config, name)
    raise TypeError(f"{name}: {type(step).__name__} is no step of a plan")


def _check_driven(
    path: Array,
    end: Array,
    step: Step,
    tool: Tool,
    config: CellConfig,
    seen: ClearanceMap | None,
    name: str,
    lowest_tip_m: float,
) -> None:
    """Check the path (N, 6) of a motion and its target (1, 6), where it has one."""
    if not isinstance(step, JointMove | LinearMove):
        return
    poses = np.concatenate([path[1:], end])
    check_poses(poses, step.load_m, obstacles(config), config, name, lowest_tip_m)
    if seen is not None:
        check_clearance(path, tool, seen, config, name)
        check_clearance(np.concatenate([path[-1:], end]), tool, seen, config, name)


def _rounded(legs: dict[int, Array], plan: MotionPlan) -> dict[int, Array]:
    """The path of each step of a blended group with its corners rounded, of the legs between their targets."""
    moves = {i: step for i in legs if isinstance(step := plan.steps[i], JointMove | LinearMove)}
    if len(moves) < 2:
        return legs
    blends = [move.blend_m for move in moves.values()]
    path = round_corners([legs[i] for i in moves], blends, rg2.T_FLANGE_TCP, _CORNER_SAMPLES)
    driven = {i: path.q[path.leg == number] for number, i in enumerate(moves)}
    result: dict[int, Array] = {}
    for i in legs:
        # A check in a corner is made in its middle.
        result[i] = driven[i] if i in driven else result[i - 1][-1:]
    return result


def tools(plan: MotionPlan) -> list[Tool]:
    """What hangs on the flange during each step of a plan.

    Fingers that closed on a load are taken to be as wide as they were before; at the start they may be wide open. Those
    that move beside a motion may be as wide as before or as they will be.
    """
    result: list[Tool] = []
    opening = held = rg2.MAX_WIDTH_M
    shaped = math.nan
    for step in plan.steps:
        if not math.isnan(shaped) and (isinstance(step, Grip | CheckHold) or is_guarded(step)):
            # The fingers are waited for.
            opening, shaped = shaped, math.nan
        if isinstance(step, Grip):
            result.append(Tool(max(opening, min(step.width_m, rg2.MAX_WIDTH_M))))
            held = max(opening, step.width_m)
            opening = step.width_m
        elif isinstance(step, Shape):
            opening = held = max(opening, step.width_m)
            shaped = step.width_m
            result.append(Tool(min(opening, rg2.MAX_WIDTH_M)))
        elif isinstance(step, JointMove):
            result.append(Tool(held if step.load_m > 0 else opening, step.load_m))
        elif isinstance(step, LinearMove):
            body_touch_m = HEAP_M if is_guarded(step) and step.touch_m is not None else 0.0
            result.append(Tool(held if step.load_m > 0 else opening, step.load_m, step.touch_m, body_touch_m))
        else:
            result.append(Tool(held))
    return result


def outside_box(points: Array, config: CellConfig, slack_m: float, lowest_m: float) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) [m] of the base frame lie outside the box of the tcp (`limits`) by more than a slack.

    Args:
        points: of the tcp.
        config: of the cell.
        slack_m: distance that does not count.
        lowest_m: height above the table that the tips may go down to; a lower one than the box's lets it reach so far.
    """
    limits = config.limits
    low, high = np.array([limits.x, limits.y, limits.z]).T
    low[2] = min(low[2], lowest_m)
    relative = points - (0.0, 0.0, config.table.height_m)
    return np.asarray(((relative < low - slack_m) | (relative > high + slack_m)).any(axis=1))


def _check_grip(step: Grip | Shape, reach: GripperRange, name: str) -> None:
    if not reach.min_width_m - _ROUNDING_M <= step.width_m <= reach.max_width_m + _ROUNDING_M:
        raise UnsafeMotion(
            f"{name}: width {1000 * step.width_m:.1f} mm is outside the gripper's {1000 * reach.min_width_m:.0f} to "
            f"{1000 * reach.max_width_m:.0f} mm{with_tips(reach)}"
        )
    if not reach.min_force_n <= step.force_n <= reach.max_force_n:
        raise UnsafeMotion(
            f"{name}: force {step.force_n:.1f} N is outside the gripper's {reach.min_force_n:.0f} to "
            f"{reach.max_force_n:.0f} N"
        )


def _joint_vector(q: Array, name: str) -> Array:
    vector = np.asarray(q, dtype=np.float64)
    if vector.shape != (6,) or not np.isfinite(vector).all():
        raise UnsafeMotion(f"{name}: joint angles {np.asarray(q).tolist()} are not six finite numbers")
    return vector


def _check_below(value: float, limit: float, what: str, unit: str, name: str) -> None:
    if not 0 < value <= limit:
        raise UnsafeMotion(f"{name}: {what} {value:.4g} {unit} is not within 0 and the limit of {limit:.4g} {unit}")


def joint_path(q: Array, step: JointMove, config: CellConfig, name: str) -> Array:
    """Joint angles (N, 6) [rad] along a joint-space motion from q (6,).

    Raises:
        UnsafeMotion: speed or acceleration are over their limits, or the tool would move too fast.
    """
    goal = _joint_vector(step.q, name)
    limits = config.limits
    _check_below(step.speed_rad_s, limits.joint_speed_rad_s, "joint speed", "rad/s", name)
    _check_below(step.acceleration_rad_s2, ur5e.MAX_JOINT_ACCELERATION, "joint acceleration", "rad/s2", name)
    way = float(np.abs(goal - q).max())
    count = max(int(np.ceil(way / _JOINT_STEP_RAD)) + 1, 2)
    path = q + np.linspace(0.0, 1.0, count)[:, None] * (goal - q)
    if way > 0:
        # A short motion never reaches its speed.
        peak = min(step.speed_rad_s, float(np.sqrt(step.acceleration_rad_s2 * way)))
        tool_speed = ur5e.tool_speed(path, (goal - q) / way * peak, rg2.CLOSED_LENGTH_M).max()
        if tool_speed > limits.tool_speed_m_s:
            raise UnsafeMotion(
                f"{name}: the tool would move at {tool_speed:.2f} m/s (limits.tool_speed_m_s = "
                f"{limits.tool_speed_m_s}); lower motion.joint_speed_rad_s"
            )
    return path


def linear_path(q: Array, step: LinearMove, config: CellConfig, name: str) -> Array:
    """Joint angles (N, 6) [rad] along a straight motion of the tcp, for an arm that starts at q (6,).

    Raises:
        UnsafeMotion: the arm cannot follow, or would be too fast.
    """
    limits = config.limits
    _check_below(step.speed_m_s, limits.tool_speed_m_s, "tool speed", "m/s", name)
    _check_below(step.acceleration_m_s2, ur5e.MAX_TOOL_ACCELERATION, "tool acceleration", "m/s2", name)
    try:
        T_goal = check_transform(step.T_base_tcp, "the target")
    except ValueError as error:
        raise UnsafeMotion(f"{name}: {error}") from error
    T_start = ur5e.forward(q) @ rg2.T_FLANGE_TCP
    length = float(np.linalg.norm(T_goal[:3, 3] - T_start[:3, 3]))
    angle = rotation_angle(T_start[:3, :3], T_goal[:3, :3])
    count = max(int(np.ceil(max(length / _LINEAR_STEP_M, angle / _ROTATION_STEP_RAD))) + 1, 2)
    T_path = interpolate_transforms(T_start, T_goal, np.linspace(0.0, 1.0, count))
    try:
        path = ur5e.inverse_along(flange_pose(T_path), q, _MAX_JOINT_JUMP_RAD)
    except ValueError as error:
        raise UnsafeMotion(f"{name}: {error}") from error
    distance = ur5e.distance_to_singularity(path)
    if distance.min() < limits.singularity:
        x, y, z = T_path[int(distance.argmin()), :3, 3]
        raise UnsafeMotion(
            f"{name}: too close to a singularity at tcp x {x:.3f}, y {y:.3f}, z {z:.3f} m "
            f"({distance.min():.3f}, limit {limits.singularity})"
        )
    # The time between samples at the speed of the step; a turn on the spot is as slow as the controller makes it.
    if length > 0:
        seconds = (length / (count - 1)) / step.speed_m_s
        joint_speed = float(np.abs(np.diff(path, axis=0)).max()) / seconds
        if joint_speed > limits.joint_speed_rad_s:
            raise UnsafeMotion(
                f"{name}: a joint would turn at {joint_speed:.2f} rad/s on the line "
                f"(limits.joint_speed_rad_s = {limits.joint_speed_rad_s}); go slower"
            )
    return path


def check_poses(
    path: Array, load_m: float, boxes: tuple[KeepOut, ...], config: CellConfig, name: str, lowest_tip_m: float
) -> None:
    """Check joint angles (N, 6) [rad]: joint limits, the tips' height, the tcp's box, keep-outs, the arm itself.

    Args:
        path: to be checked.
        load_m: how far a held object reaches below the tcp.
        boxes: that nothing may enter.
        config: of the cell.
        name: of the motion, for the error.
        lowest_tip_m: height above the table that the finger tips may go down to.

    Raises:
        UnsafeMotion: the first violation, with the place and the limit.
    """
    for where, words in _violations(path, load_m, boxes, config, lowest_tip_m):
        if where.any():
            raise UnsafeMotion(f"{name}: {words(int(where.argmax()))}")


def allowed_poses(
    path: Array, load_m: float, boxes: tuple[KeepOut, ...], config: CellConfig, lowest_tip_m: float
) -> npt.NDArray[np.bool_]:
    """Which joint angles (N, 6) [rad] `check_poses` finds nothing against; its arguments."""
    allowed = np.ones(len(path), np.bool_)
    for where, _ in _violations(path, load_m, boxes, config, lowest_tip_m):
        allowed &= ~where
    return allowed


def _violations(
    path: Array, load_m: float, boxes: tuple[KeepOut, ...], config: CellConfig, lowest_tip_m: float
) -> Iterator[tuple[npt.NDArray[np.bool_], Callable[[int], str]]]:
    """For each limit which poses (N,) violate it, and the words for one of them."""
    limits, table = config.limits, config.table.height_m
    margin = ur5e.JOINT_LIMIT - limits.joint_margin_rad

    def beyond(_: int) -> str:
        joint = int((np.abs(path) - margin).max(axis=0).argmax())
        angle = path[np.abs(path[:, joint]).argmax(), joint]
        return f"joint {joint + 1} would turn to {angle:.2f} rad (limit +-{margin[joint]:.2f} rad)"

    yield np.asarray((np.abs(path) > margin).any(axis=1)), beyond
    T_tcp = ur5e.forward(path) @ rg2.T_FLANGE_TCP
    tcp = T_tcp[:, :3, 3]

    def too_low(_: int) -> str:
        z = tcp[:, 2].min() - table
        return f"the finger tips would be {1000 * z:.1f} mm above the table (limit {1000 * lowest_tip_m:.1f} mm)"

    yield np.asarray(tcp[:, 2] < table + lowest_tip_m - _ROUNDING_M), too_low

    def left_box(i: int) -> str:
        x, y, z = tcp[i]
        return (
            f"the tcp would leave its box at x {x:.3f}, y {y:.3f}, z {z:.3f} m "
            f"(limits x {limits.x}, y {limits.y}, z {limits.z} m above the table)"
        )

    yield outside_box(tcp, config, _ROUNDING_M, lowest_tip_m), left_box
    centers = bodies.sphere_centers(path)
    radius = bodies.SPHERES.radius + limits.clearance_m
    above = bodies.SPHERES.group >= _STANDS_ON_TABLE
    yield (
        np.asarray((centers[:, above, 2] - radius[above] < table).any(axis=1)),
        lambda _: "the arm or the gripper's body would touch the table",
    )
    points = bodies.finger_points(T_tcp, load_m)
    for box in boxes:
        body = (bodies.box_distance(*box.corners(), centers) < radius)[:, bodies.SPHERES.group > 0]
        fingers = bodies.box_distance(*box.corners(), points) < limits.clearance_m
        words = f"the arm, the gripper or its load would enter the keep-out {box.name!r}"
        yield body.any(axis=1) | fingers.any(axis=1), lambda _, words=words: words  # type: ignore[misc]
    touching = bodies.self_distance(centers) < limits.clearance_m
    if load_m > 0:
        touching |= bodies.hand_distance(centers, T_tcp, load_m) < limits.clearance_m
    yield touching, lambda _: "the arm, the gripper or its load would touch the arm itself"
