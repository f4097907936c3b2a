"""Which actions would repeat one that failed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push
from robotcell.motion.rotations import GRASP_ROTATIONS, ROTATIONS

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array
    from robotcell.jobs.policy_api import Action

# An action this near to one that failed, and turned by at most one step, is the same action again.
_SAME_M = 0.020


def repeats_grasp(
    x: Array, y: Array, rotation: npt.NDArray[np.intp], barred: tuple[Action, ...]
) -> npt.NDArray[np.bool_]:
    """Which grasps are the same as one that failed; half a turn of the fingers changes nothing.

    Args:
        x: middle between the fingers [m]; `x`, `y` and `rotation` are broadcast against each other, and the answer has
            their shape.
        y: likewise.
        rotation: index of the closing direction.
        barred: actions that failed; pushes do not count.
    """
    failed = [((grasp.x, grasp.y), grasp.rotation) for grasp in barred if isinstance(grasp, Grasp)]
    return _near_one(x, y, rotation, failed, GRASP_ROTATIONS)


def repeats_push(
    x: Array, y: Array, rotation: npt.NDArray[np.intp], barred: tuple[Action, ...]
) -> npt.NDArray[np.bool_]:
    """Which pushes are the same as one that failed.

    Args:
        x: start [m]; `x`, `y` and `rotation` are broadcast against each other, and the answer has their shape.
        y: likewise.
        rotation: index of the direction.
        barred: actions that failed; grasps do not count.
    """
    failed = [(push.start, push.rotation) for push in barred if isinstance(push, Push)]
    return _near_one(x, y, rotation, failed, ROTATIONS)


def _near_one(
    x: Array,
    y: Array,
    rotation: npt.NDArray[np.intp],
    failed: list[tuple[tuple[float, float], int]],
    period: int,
) -> npt.NDArray[np.bool_]:
    """Which actions are near to one of those at (x, y) with a rotation; rotations are alike after `period` steps."""
    found = np.zeros(np.broadcast(x, y, rotation).shape, np.bool_)
    for (failed_x, failed_y), failed_rotation in failed:
        near = np.hypot(x - failed_x, y - failed_y) < _SAME_M
        turn = np.abs(rotation - failed_rotation) % period
        found |= near & (np.minimum(turn, period - turn) <= 1)
    return found
