"""Where a goal may be that was seen and is hidden now, and what has to be pushed aside to find it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Uncover
from robotcell.jobs.verdict import Result
from robotcell.motion.grasp import Grasp

if TYPE_CHECKING:
    from robotcell.config import Workspace
    from robotcell.motion.actions import Action
    from robotcell.motion.push import Push
    from robotcell.perception.view import View

# A push moves what is this near to its way, and what that meets.
_STIRRED_M = 0.06
# A goal that was seen may reach so far beyond the part of it that was.
_UNSEEN_PART_M = 0.02


def uncover(view: View, place: npt.NDArray[np.bool_]) -> Uncover:
    """What lies where a goal may be.

    Args:
        view: what is seen now.
        place: (H, W) where the goal may be.

    Raises:
        NoTarget: nothing is seen there.
    """
    # What was seen of the goal need not have been all of it.
    size = 2 * round(_UNSEEN_PART_M / view.heightmap.workspace.resolution_m) + 1
    hiding = view.segmentation.objects & (cv2.dilate(place.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
    if not hiding.any():
        raise NoTarget("the goal is not seen any more, and nothing hides the place where it was; look for it by hand")
    return Uncover(hiding)


def place_after(
    place: npt.NDArray[np.bool_], action: Action, result: Result, workspace: Workspace
) -> npt.NDArray[np.bool_] | None:
    """(H, W) where a goal may be after an action, having been at `place`; None if it may be anywhere.

    Args:
        place: (H, W) before the action.
        action: that was run.
        result: of it.
        workspace: the map.
    """
    if isinstance(action, Grasp):
        may_be_anywhere = result in {Result.LOST, Result.UNCONFIRMED, Result.UNKNOWN, Result.STOPPED}
        return None if may_be_anywhere else place
    return _pushed_along(place, action, workspace)


def _pushed_along(place: npt.NDArray[np.bool_], push: Push, workspace: Workspace) -> npt.NDArray[np.bool_]:
    """What is near the way of a push may have gone along, as far as the push went."""
    (row, col), (end_row, end_col) = (workspace.cell(*at) for at in (push.start, push.end))
    breadth = 2 * round(_STIRRED_M / workspace.resolution_m)
    stirred = cv2.line(np.zeros(place.shape, np.uint8), (col, row), (end_col, end_row), 1, breadth)
    length = round(push.length_m / workspace.resolution_m)
    trace = np.zeros((2 * length + 1, 2 * length + 1), np.uint8)
    # Dilation reads the trace backwards.
    tip = (round(length * (1 - np.cos(push.theta))), round(length * (1 - np.sin(push.theta))))
    cv2.line(trace, (length, length), tip, 1)
    return np.asarray(place | (cv2.dilate(((stirred > 0) & place).astype(np.uint8), trace) > 0))
