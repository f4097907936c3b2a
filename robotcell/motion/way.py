"""A way for an action: the plan that keeps clear of what the camera saw, over or around it where it must.

The usual plan is tried first. If something stands in its way, the tool comes down from higher up and is lifted
higher. If that is not enough, the joint motions are led over or around what is in the way by a search on a roadmap of
poses with the tool down. Then the other solutions of the arm for the pose above the action are tried (the symmetric
jaw turned by half a turn, the wrist or the elbow turned over), those nearest to the home pose first. The search is
deterministic: the same view gives the same plan.
"""

from __future__ import annotations

import heapq
from contextlib import suppress
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.surroundings import obstacles
from robotcell.errors import UnsafeMotion
from robotcell.geometry import bodies, rg2, ur5e
from robotcell.geometry.transforms import make_transform, rotation_z
from robotcell.motion.actions import above, plan_action
from robotcell.motion.clearance import Obstructed, standing_clear
from robotcell.motion.path_check import CheckedPlan, allowed_poses, check_path, check_step, tools
from robotcell.motion.plan import JointMove, MotionPlan, guarded_descents, one_by_one
from robotcell.motion.tool import flange_pose, tool_down_solutions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.actions import Action
    from robotcell.motion.clearance import Tool
    from robotcell.motion.plan import Step
    from robotcell.perception.clearance_map import ClearanceMap
    from robotcell.perception.heightmap import Heightmap

# The roadmap: tool-down poses around the base, in these steps of azimuth, radius and height above the table.
_AZIMUTH_RAD = np.radians(15.0)
_RADII_M = (0.25, 0.35, 0.45, 0.55, 0.65, 0.75)
_HEIGHTS_M = (0.20, 0.32, 0.44, 0.56, 0.68)
# Poses straight above the ends of a way.
_RISES_M = (0.06, 0.12, 0.18, 0.24, 0.32, 0.40, 0.48)
_NEIGHBOURS = 10
# Ends of a way are connected with so many of the nearest poses.
_NEAREST_TO_END = 24
# Where a motion is looked at before all of it is checked.
_GLANCES = np.array([[0.5], [0.25], [0.75]])
# Fingers in the poses of the roadmap keep this distance from the arm.
_FROM_ARM_M = 0.02
# Edges that are checked before a search is given up.
_MOST_CHECKS = 60
# Plans that are led around what is in the way before an action is given up.
_MOST_SEARCHES = 4


def plan_way(
    action: Action, heightmap: Heightmap, seen: ClearanceMap, q_start: Array, config: CellConfig
) -> CheckedPlan:
    """The checked plan of an action that keeps clear of what the camera saw.

    Args:
        action: that was decided.
        heightmap: that it was decided on.
        seen: what may stand on the table.
        q_start: joint angles (6,) [rad] where the arm stands.
        config: of the cell.

    Raises:
        Obstructed: there is no way; what stands in the way of the usual plan.
        UnsafeMotion: the usual plan breaks another limit.
    """
    plan = plan_action(action, heightmap, q_start, config)
    try:
        return check_path(plan, config, seen)
    except Obstructed as error:
        usual = error
    with suppress(UnsafeMotion):
        # What stands beside a corner may be in the way of its rounding alone, or of fingers that are still wide open.
        return check_path(one_by_one(plan), config, seen)
    with suppress(UnsafeMotion):
        # The gripper's body comes down beside what is as high as a heap of blocks.
        return check_path(guarded_descents(one_by_one(plan), config), config, seen)
    searches = 0
    last, tool = [pair for pair in zip(plan.steps, tools(plan), strict=True) if isinstance(pair[0], JointMove)][-1]
    # Every plan ends at home or over the bin: where the arm may not stand there, none is looked for.
    can_end = isinstance(last, JointMove) and bool(standing_clear(last.q[None], tool, seen, config).all())
    for q_above in tool_down_solutions(above(action, config), config) if can_end else ():
        plans = []
        for q_high in (q_above, *_poses_above(q_above, config)):
            try:
                plan = one_by_one(plan_action(action, heightmap, q_start, config, q_high))
                check_straight(plan, seen, config)
            except UnsafeMotion:
                # From higher up the arm comes down to the same pose.
                break
            plans.append(plan)
        for plan in plans:
            try:
                return check_path(plan, config, seen)
            except UnsafeMotion:
                continue
        # From the lowest place and from the highest: what lies between seldom makes a difference.
        for plan in plans[:: max(1, len(plans) - 1)]:
            if searches == _MOST_SEARCHES:
                break
            searches += 1
            try:
                return check_path(led_around(plan, seen, config), config, seen)
            except UnsafeMotion:
                continue
    raise Obstructed(f"{usual}, and no way leads over or around it", usual.obstruction, usual.q)


def led_around(plan: MotionPlan, seen: ClearanceMap, config: CellConfig) -> MotionPlan:
    """A plan with way points in the joint motions that something stands in the way of.

    Raises:
        UnsafeMotion: a straight motion is not safe, or no way leads around what is in the way of a joint motion.
    """
    steps: list[Step] = []
    for step, tool, start in zip(plan.steps, tools(plan), check_straight(plan, seen, config), strict=True):
        if isinstance(step, JointMove):
            steps.extend(_joint_way(start, step, tool, seen, config, f"{plan.label}, step {step.label!r}"))
        else:
            steps.append(step)
    return MotionPlan(plan.label, plan.q_start, tuple(steps))


def check_straight(plan: MotionPlan, seen: ClearanceMap, config: CellConfig) -> list[Array]:
    """Check the straight motions of a plan, which nothing leads around; where each step starts (6,) [rad].

    Raises:
        UnsafeMotion: one of them is not safe.
    """
    starts, q = [], plan.q_start
    for step, tool in zip(plan.steps, tools(plan), strict=True):
        starts.append(q)
        if isinstance(step, JointMove):
            q = step.q
        else:
            name = f"{plan.label}, step {step.label!r}"
            q = check_step(q, step, tool, config, seen, name, config.gripper.tip_clearance_m)[-1]
    return starts


def _joint_way(
    q: Array, step: JointMove, tool: Tool, seen: ClearanceMap, config: CellConfig, name: str
) -> list[JointMove]:
    """The joint motion itself, or one with way points before it; raises UnsafeMotion if there is none."""
    lowest = config.gripper.tip_clearance_m
    try:
        check_step(q, step, tool, config, seen, name, lowest)
    except Obstructed as error:
        blocked = error
    else:
        return [step]

    def is_free(start: Array, end: Array) -> bool:
        # A few poses on the way tell most ways that are not free.
        if not standing_clear(start + _GLANCES * (end - start), tool, seen, config).all():
            return False
        part = JointMove(step.label, end, step.speed_rad_s, step.acceleration_rad_s2, step.load_m)
        try:
            check_step(start, part, tool, config, seen, name, lowest)
        except UnsafeMotion:
            return False
        return True

    def seconds(start: Array, end: Array) -> float:
        way = float(np.abs(end - start).max())
        return way / step.speed_rad_s + step.speed_rad_s / step.acceleration_rad_s2

    if not standing_clear(step.q[None], tool, seen, config).all():
        raise blocked
    poses = _roadmap(config.motion.home_q, config.table.height_m)
    # No way leads through a pose in which the arm may not stand.
    poses = poses[allowed_poses(poses, step.load_m, obstacles(config), config, lowest)]
    poses = poses[standing_clear(poses, tool, seen, config)]
    ends = [np.vstack([end, *_poses_above(end, config)]) for end in (q, step.q)]
    found = _shortest_way(ends[0], ends[1], poses, is_free, seconds)
    if found is None:
        raise blocked
    label = f"{step.label}, way point"
    return [
        *(
            JointMove(f"{label} {i}", via, step.speed_rad_s, step.acceleration_rad_s2, step.load_m)
            for i, via in enumerate(found, start=1)
        ),
        step,
    ]


def _shortest_way(
    starts: Array,
    ends: Array,
    poses: Array,
    is_free: Callable[[Array, Array], bool],
    seconds: Callable[[Array, Array], float],
) -> list[Array] | None:
    """Way points between `starts[0]` and `ends[0]`, or None.

    The way that takes the least time is looked for, and its motions are checked; a motion that is not free is taken
    out, and the search begins again.

    Args:
        starts: joint angles (N, 6) [rad]: where the way begins, and poses straight above it.
        ends: likewise where it ends.
        poses: (M, 6) to go through.
        is_free: whether a joint motion is safe.
        seconds: how long it takes.
    """
    nodes = np.vstack([starts, ends, poses])
    last = len(starts)
    columns = len(starts) + len(ends)
    far = np.abs(nodes[:, None] - nodes[None]).max(axis=2)
    edges: list[dict[int, float]] = [{} for _ in nodes]

    def connect(i: int, j: int) -> None:
        if i != j and j not in edges[i]:
            edges[i][j] = edges[j][i] = seconds(nodes[i], nodes[j])

    for i in range(columns):
        for j in range(columns):
            connect(i, j)
        for j in columns + np.argsort(far[i, columns:], kind="stable")[:_NEAREST_TO_END]:
            connect(i, int(j))
    for i in range(columns, len(nodes)):
        for j in columns + np.argsort(far[i, columns:], kind="stable")[1 : _NEIGHBOURS + 1]:
            connect(i, int(j))
    known_free: set[tuple[int, int]] = set()
    checks = 0
    while checks < _MOST_CHECKS:
        way = _dijkstra(edges, 0, last)
        if way is None:
            return None
        for i, j in pairwise(way):
            if (i, j) in known_free:
                continue
            checks += 1
            if not is_free(nodes[i], nodes[j]):
                del edges[i][j], edges[j][i]
                break
            known_free.add((i, j))
        else:
            return [nodes[i] for i in way[1:-1]]
    return None


def _dijkstra(edges: Sequence[dict[int, float]], start: int, end: int) -> list[int] | None:
    cost, before = {start: 0.0}, {start: start}
    queue = [(0.0, start)]
    done: set[int] = set()
    while queue:
        at, node = heapq.heappop(queue)
        if node in done:
            continue
        done.add(node)
        if node == end:
            way = [end]
            while way[-1] != start:
                way.append(before[way[-1]])
            return way[::-1]
        for other, step in edges[node].items():
            if at + step < cost.get(other, np.inf):
                cost[other], before[other] = at + step, node
                heapq.heappush(queue, (at + step, other))
    return None


def _poses_above(q: Array, config: CellConfig) -> list[Array]:
    """Joint angles of poses straight above that of q, as far as the arm reaches without turning anything over."""
    T = ur5e.forward(q) @ rg2.T_FLANGE_TCP
    result: list[Array] = []
    near = q
    for rise in _RISES_M:
        T_up = T.copy()
        T_up[2, 3] += rise
        if T_up[2, 3] > config.table.height_m + config.limits.z[1]:
            break
        solution = ur5e.inverse(flange_pose(T_up), near)
        if solution is None or np.abs(solution - near).max() > np.pi / 2:
            break
        result.append(solution)
        near = solution
    return result


@lru_cache(maxsize=4)
def _roadmap(home_q: tuple[float, ...], table_height_m: float) -> Array:
    """Joint angles (N, 6) [rad] of tool-down poses around the base, reached as the home pose is."""
    home = np.array(home_q)
    T_home = ur5e.forward(home)
    radius = float(np.hypot(*T_home[:2, 3]))
    poses = []
    for turn in np.arange(-np.pi, np.pi - 1e-9, _AZIMUTH_RAD):
        start = home + np.array([turn, 0.0, 0.0, 0.0, 0.0, 0.0])
        for r in _RADII_M:
            for z in _HEIGHTS_M:
                T = make_transform(rotation_z(turn), (0.0, 0.0, 0.0)) @ T_home
                T[:2, 3] *= r / radius
                T[2, 3] = table_height_m + z + rg2.CLOSED_LENGTH_M
                q = ur5e.inverse(T, start)
                if q is not None and np.abs(q - start).max() < np.pi / 2:
                    poses.append(q)
    result = np.array(poses).reshape(-1, 6)
    # The fingers, which the path check holds against the arm only where they carry something, keep clear of it too.
    T_tcp = ur5e.forward(result) @ rg2.T_FLANGE_TCP
    result = result[bodies.hand_distance(bodies.sphere_centers(result), T_tcp, 0.0) > _FROM_ARM_M]
    result.flags.writeable = False
    return result
