"""The way out: from wherever the arm stands back to the home pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotcell.errors import UnsafeMotion
from robotcell.motion.clearance import Obstructed
from robotcell.motion.grasp import GRASP_DEPTH_M
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, MotionPlan, Step, home_move, linear_move
from robotcell.motion.tool import touch_height
from robotcell.motion.way import led_around

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.interfaces import ArmState
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.clearance_map import ClearanceMap

# Where nobody looked the arm goes up as far as it can, in these steps.
_RISE_STEP_M = 0.10


def check_retreat(state: ArmState, config: CellConfig, seen: ClearanceMap | None) -> CheckedPlan:
    """The way home from wherever the arm stands: straight up, open the fingers, and home.

    By what the camera saw before the arm moved, the way leads over or around what stands there. Where nobody looked,
    the arm goes up as high as it can first: what stands higher in its way home is not known.

    Args:
        state: of the arm, as measured.
        config: of the cell.
        seen: what may stand on the table; None if nobody looked.

    Raises:
        UnsafeMotion: the way is not safe.
    """
    if seen is not None:
        plan = plan_retreat(state, config)
        try:
            return check_path(plan, config, seen)
        except Obstructed:
            return check_path(led_around(plan, seen, config), config, seen)
    up_m = config.limits.z[1]
    while up_m > _lowest_rise(config):
        try:
            return check_path(plan_retreat(state, config, up_m), config)
        except UnsafeMotion:
            up_m -= _RISE_STEP_M
    return check_path(plan_retreat(state, config), config)


def plan_retreat(state: ArmState, config: CellConfig, up_m: float = 0.0) -> MotionPlan:
    """Straight up at least to the approach height, open the fingers, go home: from wherever the arm stands.

    Args:
        state: of the arm, as measured.
        config: of the cell.
        up_m: height above the table to go up to, if it is higher [m].
    """
    clear_z = config.table.height_m + max(up_m, _lowest_rise(config))
    steps: list[Step] = []
    if state.T_base_tcp[2, 3] < clear_z:
        T_up = state.T_base_tcp.copy()
        T_up[2, 3] = clear_z
        # The fingers may stand among what they touched.
        steps.append(linear_move("retreat", T_up, config, touch_m=touch_height(0.0)))
    steps.append(Grip("open", config.gripper.preshape_m, config.gripper.force_n))
    steps.append(home_move(config))
    return MotionPlan("retreat", state.q, tuple(steps))


def _lowest_rise(config: CellConfig) -> float:
    return config.motion.approach_m + GRASP_DEPTH_M
