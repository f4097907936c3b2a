"""The two actions of a policy, and the plan of either."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from robotcell.motion.grasp import Grasp, above_grasp, plan_grasp
from robotcell.motion.push import Push, above_push, plan_push

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.plan import MotionPlan
    from robotcell.perception.heightmap import Heightmap

Action: TypeAlias = Grasp | Push


def plan_action(
    action: Action, heightmap: Heightmap, q_start: Array, config: CellConfig, q_above: Array | None = None
) -> MotionPlan:
    """The motion of a grasp or a push, from `q_start` (6,) [rad] back to the home pose; see `plan_grasp`, `plan_push`.

    Raises:
        UnsafeMotion: a pose is out of reach, or the push is too short to move anything.
    """
    if isinstance(action, Grasp):
        return plan_grasp(action, heightmap, q_start, config, q_above)
    return plan_push(action, heightmap, q_start, config, q_above)


def above(action: Action, config: CellConfig) -> Array:
    """T_base_tcp (4, 4) from which the tool comes straight down for an action."""
    return above_grasp(action, config) if isinstance(action, Grasp) else above_push(action, config)
