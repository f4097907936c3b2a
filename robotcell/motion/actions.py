"""The two actions of a policy, and the plan of either."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from robotcell.motion.grasp import Grasp, plan_grasp
from robotcell.motion.push import Push, plan_push

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.plan import MotionPlan
    from robotcell.perception.heightmap import Heightmap

Action: TypeAlias = Grasp | Push


def plan_action(action: Action, heightmap: Heightmap, q_start: Array, config: CellConfig) -> MotionPlan:
    """The motion of a grasp or a push, from `q_start` (6,) [rad] back to the home pose.

    Raises:
        UnsafeMotion: a pose is out of reach, or the push is too short to move anything.
    """
    if isinstance(action, Grasp):
        return plan_grasp(action, heightmap, q_start, config)
    return plan_push(action, heightmap, q_start, config)
