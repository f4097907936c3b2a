"""The ways out: from wherever the arm stands back to the home pose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry import rg2
from robotcell.motion.grasp import GRASP_DEPTH_M, LOAD_REACH_M, carry_height
from robotcell.motion.plan import Grip, LinearMove, MotionPlan, Step, home_move, linear_move

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.interfaces import ArmState

# Under the 250 mm/s that ISO 10218-1 calls reduced speed: 0.2 rad/s turn a tool 1.1 m from the axis at 220 mm/s.
SLOW_M_S = 0.1
SLOW_RAD_S = 0.2
# An arm this near to the home pose is at home.
_AT_HOME_RAD = 0.01


def at_home(state: ArmState, config: CellConfig) -> bool:
    """Whether the arm stands at the home pose."""
    return float(np.abs(state.q - np.array(config.motion.home_q)).max()) <= _AT_HOME_RAD


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


def plan_recovery(state: ArmState, config: CellConfig) -> MotionPlan:
    """Straight up and home, slowly, the fingers as they are, so that nothing falls; no step for an arm at home."""
    if at_home(state, config):
        return MotionPlan("recovery", state.q, ())
    home = home_move(config, LOAD_REACH_M)
    slow = replace(home, speed_rad_s=min(SLOW_RAD_S, home.speed_rad_s))
    return MotionPlan("recovery", state.q, (*_slowly(_rise(state, config)), slow))


def plan_feel(state: ArmState, config: CellConfig) -> MotionPlan:
    """Straight up, and close the fingers there: what they then are apart is what they hold."""
    feel = Grip("feel what is held", rg2.MIN_WIDTH_M, config.gripper.force_n)
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
