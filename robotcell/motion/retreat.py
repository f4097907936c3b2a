"""The way out: from wherever the arm stands back to the home pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotcell.motion.grasp import GRASP_DEPTH_M
from robotcell.motion.plan import Grip, MotionPlan, Step, home_move, linear_move

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.interfaces import ArmState


def plan_retreat(state: ArmState, config: CellConfig) -> MotionPlan:
    """Straight up to the approach height, open the fingers, go home: from wherever the arm stands."""
    clear_z = config.table.height_m + config.motion.approach_m + GRASP_DEPTH_M
    steps: list[Step] = []
    if state.T_base_tcp[2, 3] < clear_z:
        T_up = state.T_base_tcp.copy()
        T_up[2, 3] = clear_z
        steps.append(linear_move("retreat", T_up, config))
    steps.append(Grip("open", config.gripper.preshape_m, config.gripper.force_n))
    steps.append(home_move(config))
    return MotionPlan("retreat", state.q, tuple(steps))
