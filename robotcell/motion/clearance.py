"""The clearance of arm, gripper and load from what may stand on the table, along a path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import UnsafeMotion
from robotcell.geometry import bodies, rg2, ur5e

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.perception.clearance_map import ClearanceMap

# Besides `limits.clearance_m`: how far a calibrated camera, the nominal kinematics and an arm that follows its path may
# be off together, in free motion.
_MAP_ERROR_M = 0.010
# A body that is nearer than it should be at the start of a motion may get nearer by this (rounding of the map).
_ROUNDING_M = 0.002
# Samples along a path are at most so far apart: the outstretched tcp then moves by less than twice the clearance.
_JOINT_STEP_RAD = 0.020
# Beyond this a clearance is not told apart.
FAR_M = 0.080
# Links that stand on the table are no part of the check.
_ARM = np.flatnonzero((bodies.SPHERES.group >= 2) & (bodies.SPHERES.group != bodies.GRIPPER_GROUP))


@dataclass(frozen=True)
class Tool:
    """What hangs on the flange during a motion.

    Attributes:
        opening_m: between the finger tips.
        load_m: how far a load reaches below the tcp; 0 without one.
        touch_m: height above the table [m] up to which things may be touched by fingers and load; None where nothing
            may be touched.
        body_touch_m: likewise by the gripper's body: in a guarded motion among heaped blocks, which ends at a contact.
    """

    opening_m: float
    load_m: float = 0.0
    touch_m: float | None = None
    body_touch_m: float = 0.0


@dataclass(frozen=True)
class Obstruction:
    """What is in the way of a motion.

    Attributes:
        x, y: where it stands, base frame [m].
        height_m: up to which it may reach above the table.
        open_top: it reaches out of the picture, and may be taller.
        looked_at: the camera looked there; otherwise something of that height is only presumed.
        body: that would come too near.
    """

    x: float
    y: float
    height_m: float
    open_top: bool
    looked_at: bool
    body: str

    def __str__(self) -> str:
        place = f"at x {self.x:.2f}, y {self.y:.2f} m"
        if not self.looked_at:
            what = f"what the camera does not look at {place}, taken to be {self.height_m:.2f} m high,"
        elif self.open_top:
            what = f"an object {place}, taller than the camera sees,"
        else:
            what = f"an object up to {self.height_m:.2f} m high {place}"
        return f"{what} stands in the way of the {self.body}"


class Obstructed(UnsafeMotion):
    """A motion that something stands in the way of.

    Attributes:
        obstruction: that was met first.
        q: joint angles (6,) [rad] at which it was met.
    """

    def __init__(self, message: str, obstruction: Obstruction, q: Array) -> None:
        super().__init__(message)
        self.obstruction = obstruction
        self.q = q


def check_clearance(path: Array, tool: Tool, seen: ClearanceMap, config: CellConfig, name: str) -> None:
    """Check that arm, gripper and load keep clear along a path.

    In free motion everything keeps `limits.clearance_m` and the map's error from every column. Where contact is meant
    (`Tool.touch_m`, `Tool.body_touch_m`), links do so still, but gripper and load may touch what is not taller. Where
    a body stands nearer at the start already, it must not come nearer still.

    Args:
        path: joint angles (N, 6) [rad], from where the motion starts.
        tool: on the flange.
        seen: what may stand on the table.
        config: of the cell.
        name: of the motion, for the error.

    Raises:
        Obstructed: the first place where it is not so.
    """
    path = densified(path)
    margin = config.limits.clearance_m + _MAP_ERROR_M
    gaps, needed, points = _gaps(path, tool, seen, margin)
    needed = np.minimum(needed, gaps[0] - _ROUNDING_M)
    short = (gaps < needed)[1:]
    if not short.any():
        return
    sample = int(short.any(axis=1).argmax()) + 1
    worst = int(np.where(short[sample - 1], gaps[sample] - needed, np.inf).argmin())
    x, y, z = points(sample, worst)
    above = 0.0 if tool.touch_m is None else tool.touch_m
    lowest = max(z - config.table.height_m - FAR_M, above if _is_finger(worst, tool) else 0.0)
    at_x, at_y, height, open_top = seen.tallest_near(x, y, 0.12, lowest)
    obstruction = Obstruction(at_x, at_y, height, open_top, seen.looks_at(at_x, at_y), _body_name(worst, tool))
    raise Obstructed(f"{name}: {obstruction}", obstruction, path[sample])


def standing_clear(poses: Array, tool: Tool, seen: ClearanceMap, config: CellConfig) -> npt.NDArray[np.bool_]:
    """Whether the arm keeps clear in each of the poses (N, 6) [rad], as in free motion."""
    if not len(poses):
        return np.zeros(0, np.bool_)
    margin = config.limits.clearance_m + _MAP_ERROR_M
    gaps, needed, _ = _gaps(poses, tool, seen, margin)
    return np.asarray((gaps >= needed).all(axis=1))


def smallest_gaps(path: Array, tool: Tool, seen: ClearanceMap) -> Array:
    """The clearance (N,) [m], at most `FAR_M`, at each sample of a path (N, 6); without what may touch there."""
    gaps, needed, _ = _gaps(path, tool, seen, FAR_M)
    return np.asarray(np.where(needed > 0, gaps, FAR_M).min(axis=1))


def densified(path: Array) -> Array:
    """A path (N, 6) with further samples between, so that no joint turns by more than 20 mrad from one to the next."""
    turn = np.abs(np.diff(path, axis=0)).max(axis=1, initial=0.0)
    parts = np.maximum(1, np.ceil(turn / _JOINT_STEP_RAD - 1e-9)).astype(np.intp)
    if (parts == 1).all():
        return path
    at = np.concatenate([[0.0], np.cumsum(1 / np.repeat(parts, parts))])
    whole = np.minimum(at.astype(np.intp), len(path) - 2)
    return np.asarray(path[whole] + (at - whole)[:, None] * (path[whole + 1] - path[whole]))


def _gaps(
    path: Array, tool: Tool, seen: ClearanceMap, margin: float
) -> tuple[Array, Array, Callable[[int, int], Array]]:
    """Gaps (N, P) [m] of all spheres, what each of them needs (P,), and where sphere p stands at sample n."""
    sphere = bodies.SPHERES
    arm = bodies.sphere_centers(path)[:, _ARM]
    radius = np.broadcast_to(sphere.radius[_ARM], arm.shape[:2])
    arm_gaps = seen.gaps(arm.reshape(-1, 3), radius.ravel(), 0.0, margin).reshape(arm.shape[:2])

    shape = bodies.tool_points(tool.opening_m, tool.load_m)
    T_tcp = ur5e.forward(path) @ rg2.T_FLANGE_TCP
    tool_gaps = np.full((len(path), len(shape.points)), margin)
    # The lowest point of the tool bounds which samples can come near anything at all.
    z = T_tcp[:, 2, :3] @ shape.points.T + T_tcp[:, 2, 3:]
    near = np.flatnonzero(z.min(axis=1) - shape.radius_m - margin < seen.top_m + seen.table_height_m)
    if near.size:
        at = shape.points @ np.swapaxes(T_tcp[near, :3, :3], 1, 2) + T_tcp[near, None, :3, 3]
        groups = [(np.ones(len(shape.points), np.bool_), 0.0)]
        if tool.touch_m is not None:
            groups = [(shape.body, tool.body_touch_m), (~shape.body, tool.touch_m)]
        for members, above in groups:
            points = at[:, members]
            gaps = seen.gaps(points.reshape(-1, 3), np.full(points[..., 0].size, shape.radius_m), above, margin)
            tool_gaps[np.ix_(near, members)] = gaps.reshape(points.shape[:2])
    needed_tool = np.full(len(shape.points), margin)
    if tool.touch_m is not None:
        # The map rounds up, which is margin enough for the slow part.
        needed_tool = np.zeros(len(shape.points))

    def place(sample: int, index: int) -> Array:
        if index < len(_ARM):
            return np.asarray(arm[sample, index])
        point = shape.points[index - len(_ARM)]
        return np.asarray(T_tcp[sample, :3, :3] @ point + T_tcp[sample, :3, 3])

    needed = np.concatenate([np.full(len(_ARM), margin), needed_tool])
    return np.concatenate([arm_gaps, tool_gaps], axis=1), needed, place


def _is_finger(index: int, tool: Tool) -> bool:
    return index >= len(_ARM) and not bodies.tool_points(tool.opening_m, tool.load_m).body[index - len(_ARM)]


def _body_name(index: int, tool: Tool) -> str:
    if index < len(_ARM):
        return bodies.BODY_NAMES[int(bodies.SPHERES.group[_ARM[index]])]
    if not _is_finger(index, tool):
        return "gripper"
    return "load or the fingers" if tool.load_m > 0 else "fingers"
