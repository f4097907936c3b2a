"""What an action came to, by the gripper and by the heightmaps before and after it."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from robotcell.motion.executor import Ending, Execution
from robotcell.motion.grasp import HELD_AFTER_LIFT, HELD_OVER_BIN, Grasp
from robotcell.perception.goals import goal_color

if TYPE_CHECKING:
    from robotcell.motion.actions import Action
    from robotcell.perception.heightmap import Heightmap
    from robotcell.perception.segmentation import Instance
    from robotcell.perception.view import View

# A cell whose height changes by more than this has changed hands; five times the depth noise of the camera.
_CHANGED_M = 0.010
# An object has left its place when this share of the cells that show it is lower than before.
_GONE_SHARE = 0.6
# A push after which less of the table than this looks different moved nothing: a third of a block's smallest face.
_MOVED_M2 = 400e-6
# What changed must be at least this wide to count: the noise of depth flickers along edges, a cell or two wide.
_MOVED_WIDTH_M = 0.007
# The fingers can only have taken an object that was seen this close to them.
_REACH_M = 0.06


class Result(str, enum.Enum):
    """What an action came to."""

    PICKED = "picked"
    WRONG_OBJECT = "wrong object"
    MISSED = "missed"  # the fingers closed on nothing
    LOST = "lost"  # held after the lift, no longer over the bin
    COLLIDED = "collided"  # something was in the way of the fingers
    UNCONFIRMED = "unconfirmed"  # the gripper held something that the camera does not miss
    PUSHED = "pushed"
    NOTHING_MOVED = "nothing moved"
    REFUSED = "refused"  # the plan was unsafe; nothing moved
    DECLINED = "declined"  # by somebody who was asked; nothing moved
    STOPPED = "stopped"  # a device, the safety layer or an operator stopped the cell
    UNKNOWN = "unknown"  # the job was cut off meanwhile


# After these the scene is another one, and what failed before may work now.
SCENE_CHANGED = frozenset(
    {
        Result.PICKED,
        Result.WRONG_OBJECT,
        Result.PUSHED,
        Result.LOST,
        Result.UNCONFIRMED,
        Result.STOPPED,
        Result.UNKNOWN,
    }
)


@dataclass(frozen=True)
class Outcome:
    """What came of an action.

    Attributes:
        result: in a word.
        picked: colour of the object that left the table; None where none did.
        detail: in a sentence.
        peak_force_n: largest contact force of its guarded motions; NaN where it was cut off before it was known.
        grip_force_n: largest contact force while the fingers moved; NaN where they did not, or it is not known.
    """

    result: Result
    picked: str | None
    detail: str
    peak_force_n: float
    grip_force_n: float

    @property
    def success(self) -> bool:
        """Whether the action did what it was for."""
        return self.result in {Result.PICKED, Result.PUSHED}


def judge(action: Action, goal: str | None, before: View, after: View, execution: Execution) -> Outcome:
    """What an action came to.

    Args:
        action: that was run.
        goal: the word of the goal that it was for; None for any object.
        before: what it was decided on.
        after: the view after it.
        execution: of its plan.
    """
    if isinstance(action, Grasp):
        result, picked, detail = _judge_grasp(action, goal, before, after, execution)
    else:
        changed = _changed_area(before.heightmap, after.heightmap)
        result = Result.PUSHED if changed >= _MOVED_M2 else Result.NOTHING_MOVED
        picked, detail = None, f"{1e4 * changed:.0f} cm2 of the table changed"
    return Outcome(result, picked, detail, execution.peak_force_n, execution.grip_force_n)


def judge_cut_off(action: Action, goal: str | None, before: View | None, after: View, held: str | None) -> Outcome:
    """What an action came to that was cut off, the gripper being empty now.

    Args:
        action: that was cut off.
        goal: the word of the goal that it was for; None for any object.
        before: what it was decided on; None if its pictures are gone.
        after: what is seen now.
        held: label of the last check at which the fingers held something; None before the first.
    """
    result, picked, detail = Result.UNKNOWN, None, "the table does not tell what came of it"
    if isinstance(action, Grasp) and before is not None:
        taken = _taken(action, before, after)
        if held == HELD_OVER_BIN:
            # After this the fingers open nowhere else than over the bin.
            result, picked, detail = _judge_taken(taken, goal)
        elif taken is not None:
            result, detail = Result.LOST, f"{taken.color_name} is neither in its place nor in the gripper"
    return Outcome(result, picked, f"cut off; {detail}", float("nan"), float("nan"))


def _judge_grasp(
    grasp: Grasp, goal: str | None, before: View, after: View, execution: Execution
) -> tuple[Result, str | None, str]:
    width = f"{1000 * execution.width_m:.1f} mm"
    if execution.ending is Ending.CONTACT:
        return Result.COLLIDED, None, f"{execution.peak_force_n:.0f} N during {execution.step!r}"
    if execution.ending is Ending.EMPTY:
        if execution.step == HELD_AFTER_LIFT:
            return Result.MISSED, None, f"the fingers were {width} apart at {execution.step!r}"
        return Result.LOST, None, f"lost on the way: the fingers were {width} apart at {execution.step!r}"
    result, picked, detail = _judge_taken(_taken(grasp, before, after), goal)
    return result, picked, f"{detail}, held {width} wide" if result is Result.PICKED else detail


def _judge_taken(taken: Instance | None, goal: str | None) -> tuple[Result, str | None, str]:
    """What a grasp came to that held something over the bin, by what is missing on the table."""
    if taken is None:
        return Result.UNCONFIRMED, None, "something was held, but nothing is missing on the table"
    picked = taken.color_name
    if goal is not None and picked != goal_color(goal):
        return Result.WRONG_OBJECT, picked, f"took {picked} instead of {goal}"
    return Result.PICKED, picked, picked


def _taken(grasp: Grasp, before: View, after: View) -> Instance | None:
    """The object that left the table: the one that the grasp was aimed at, or else the nearest that is gone."""
    aimed_at = before.segmentation.labels[before.heightmap.workspace.cell(grasp.x, grasp.y)]
    gone: list[tuple[bool, float, Instance]] = []
    for instance in before.segmentation.instances:
        x, y = instance.centroid
        distance = float(np.hypot(x - grasp.x, y - grasp.y))
        near = instance.label == aimed_at or distance < _REACH_M
        if near and _is_gone(instance, before, after):
            gone.append((instance.label != aimed_at, distance, instance))
    return min(gone, key=lambda entry: entry[:2])[2] if gone else None


def _is_gone(instance: Instance, before: View, after: View) -> bool:
    """Whether the place where an object was is lower than before, or shows another one that fell into it."""
    known = np.isfinite(before.heightmap.height_m) & np.isfinite(after.heightmap.height_m)
    place = before.segmentation.mask(instance) & known
    sunk = before.heightmap.height_m[place] - after.heightmap.height_m[place] > _CHANGED_M
    same_color = [other.label for other in after.segmentation.instances if other.color_name == instance.color_name]
    replaced = ~np.isin(after.segmentation.labels[place], [0, *same_color])
    return bool(place.any() and (sunk | replaced).mean() >= _GONE_SHARE)


def _changed_area(before: Heightmap, after: Heightmap) -> float:
    """How much of the table [m2] is higher or lower than before, edges that flicker left out."""
    resolution = before.workspace.resolution_m
    with np.errstate(invalid="ignore"):
        changed = (np.abs(before.height_m - after.height_m) > _CHANGED_M).astype(np.uint8)
    width = max(3, round(_MOVED_WIDTH_M / resolution))
    return float(cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((width, width), np.uint8)).sum()) * resolution**2
