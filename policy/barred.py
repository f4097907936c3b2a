"""Which actions would repeat one that failed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from policy.grasp_room import DIRECTIONS
from robotcell.motion.rotations import ROTATIONS
from robotcell.jobs.policy_api import Action, Primitive

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

# An action this near to one that failed, and turned by at most one step, is the same action again.
_SAME_M = 0.020
# Rotations are alike after so many steps.
_PERIOD = {Primitive.GRASP: DIRECTIONS, Primitive.PUSH: ROTATIONS}


def repeats(
    primitive: Primitive, x: Array, y: Array, rotation: npt.NDArray[np.intp], barred: tuple[Action, ...]
) -> npt.NDArray[np.bool_]:
    """Which actions are the same as one of those that are barred.

    Args:
        primitive: of all the actions.
        x: positions [m]; `x`, `y` and `rotation` are broadcast against each other, and the answer has their shape.
        y: positions [m].
        rotation: steps of 22.5 degrees.
        barred: actions that failed; those of another primitive do not count.
    """
    found = np.zeros(np.broadcast(x, y, rotation).shape, np.bool_)
    period = _PERIOD[primitive]
    for failed in barred:
        if failed.primitive is primitive:
            near = np.hypot(x - failed.xyz[0], y - failed.xyz[1]) < _SAME_M
            turn = np.abs(rotation - failed.rotation) % period
            found |= near & (np.minimum(turn, period - turn) <= 1)
    return found
