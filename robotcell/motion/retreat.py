"""The ways out: from wherever the arm stands back to the home pose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.fingers import closed_width
from robotcell.errors import UnsafeMotion
from robotcell.motion.clearance import Obstructed
from robotcell.motion.grasp import GRASP_DEPTH_M, LOAD_REACH_M, carry_height
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, LinearMove, MotionPlan, Step, home_move, linear_move
from robotcell.motion.tool import touch_height
from robotcell.motion.way import led_around

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.interfaces import ArmState
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.clearance_map import ClearanceMap

# Where nobody looked the arm goes up as far as it can, in these steps.
_RISE_STEP_M = 0.10

# Under the 250 mm/s that ISO 10218-1 calls reduced speed: 0.2 rad/s turn a tool 1.1 m from the axis at 220 mm/s.
SLOW_M_S = 0.1
SLOW_RAD_S = 0.2
# An arm this near to the home pose is at home.
_AT_HOME_RAD = 0.01


def at_home(state: ArmState, config: CellConfig) -> bool:
    """Whether the arm stands at the home pose."""
    return float(np.abs(state.q - np.array(config.motion.home_q)).max()) <= _AT_HOME_RAD


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
    for up_m in np.arange(config.limits.z[1], _lowest_rise(config), -_RISE_STEP_M):
        try:
            return check_path(plan_retreat(state, config, float(up_m)), config)
        except UnsafeMotion:
            continue
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


def plan_recovery(state: ArmState, config: CellConfig) -> MotionPlan:
    """Straight up and home, slowly, the fingers as they are, so that nothing falls; no step for an arm at home."""
    if at_home(state, config):
        return MotionPlan("recovery", state.q, ())
    home = home_move(config, LOAD_REACH_M)
    slow = replace(home, speed_rad_s=min(SLOW_RAD_S, home.speed_rad_s))
    return MotionPlan("recovery", state.q, (*_slowly(_rise(state, config)), slow))


def plan_feel(state: ArmState, config: CellConfig) -> MotionPlan:
    """Straight up, and close the fingers there: what they then are apart is what they hold."""
    feel = Grip("feel what is held", closed_width(config), config.gripper.force_n)
    return MotionPlan("feel what is held", state.q, (*_rise(state, config), feel))


def _rise(state: ArmState, config: CellConfig) -> tuple[LinearMove, ...]:
    """Straight up until a load would pass over the walls of the bin."""
    clear_z = config.table.height_m + carry_height(config)
    if state.T_base_tcp[2, 3] >= clear_z:
        return ()
    T_up = state.T_base_tcp.copy()
    T_up[2, 3] = clear_z
    return (replace(linear_move("straight up", T_up, config), load_m=LOAD_REACH_M),)


def _slowly(steps: tuple[LinearMove, ...]) -> tuple[LinearMove, ...]:
    return tuple(replace(step, speed_m_s=min(SLOW_M_S, step.speed_m_s)) for step in steps)
