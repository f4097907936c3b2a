"""Ways over and around what stands on the table, by maps made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from robotcell.config import CellConfig
from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.actions import plan_action
from robotcell.motion.clearance import Obstructed, Tool, check_clearance, densified
from robotcell.motion.grasp import Grasp
from robotcell.motion.path_check import check_path, tools
from robotcell.motion.plan import JointMove, LinearMove
from robotcell.motion.retreat import check_retreat
from robotcell.motion.tool import tool_down
from robotcell.motion.way import plan_way
from robotcell.perception.clearance_map import RESOLUTION_M, ClearanceMap
from tests.robotcell.maps import action, heightmap

CONFIG = CellConfig()
HOME = np.array(CONFIG.motion.home_q)
GOAL = Grasp(-0.5, 0.0, 0.05, 4, 1.0)
ORIGIN, SHAPE = (-0.95, -0.70), (280, 200)


def map_of(*boxes):
    """A map of boxes (x, y, half side, height) that are seen from all sides."""
    ceiling = np.zeros(SHAPE, np.float32)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] * RESOLUTION_M + RESOLUTION_M / 2
    x, y = x + ORIGIN[0], y + ORIGIN[1]
    for bx, by, half, height in boxes:
        inside = (np.abs(x - bx) <= half) & (np.abs(y - by) <= half)
        ceiling[inside] = np.maximum(ceiling[inside], height)
    return ClearanceMap(ORIGIN, ceiling, np.ones(SHAPE, np.bool_), np.zeros(SHAPE, np.bool_), 0.0)


CUBE = (-0.5, 0.0, 0.025, 0.05)


def assert_clear(checked, seen):
    """Outside of what is meant, no sphere of the robot enters a column, by distances computed anew."""
    for step, tool, path in zip(checked.plan.steps, tools(checked.plan), checked.joint_paths, strict=True):
        if isinstance(step, JointMove) or (isinstance(step, LinearMove) and step.touch_m is None):
            check_clearance(densified(path), Tool(tool.opening_m, tool.load_m), seen, CONFIG, step.label)


def test_where_nothing_is_in_the_way_the_plan_is_the_usual_one():
    usual = plan_action(GOAL, heightmap(), HOME, CONFIG)
    found = plan_way(GOAL, heightmap(), map_of(CUBE), HOME, CONFIG).plan
    assert [step.label for step in found.steps] == [step.label for step in usual.steps]
    for a, b in zip(found.steps, usual.steps, strict=True):
        if isinstance(a, JointMove):
            np.testing.assert_array_equal(a.q, b.q)


@pytest.mark.parametrize("post", [(-0.5, 0.115, 0.0325, 0.25), (-0.5, 0.115, 0.0325, 0.29)])
def test_a_way_leads_over_or_around_a_post_beside_the_goal(post):
    seen = map_of(CUBE, post)
    usual = plan_action(GOAL, heightmap(), HOME, CONFIG)
    with pytest.raises(Obstructed, match=r"up to 0\.\d+ m high at x -0\.\d+, y 0\.\d+ m stands in the way of the"):
        check_path(usual, CONFIG, seen)
    found = plan_way(GOAL, heightmap(), seen, HOME, CONFIG)
    assert_clear(found, seen)
    again = plan_way(GOAL, heightmap(), seen, HOME, CONFIG)
    assert [step.label for step in again.plan.steps] == [step.label for step in found.plan.steps]


def test_fingers_do_not_come_down_on_a_post_and_a_wall_of_them_is_refused():
    on_a_post = map_of(CUBE, (-0.5, 0.055, 0.015, 0.25), (-0.5, -0.055, 0.015, 0.25))
    with pytest.raises(Obstructed, match="no way leads over or around it"):
        plan_way(GOAL, heightmap(), on_a_post, HOME, CONFIG)


def test_fingers_may_touch_blocks_where_contact_is_meant_and_nowhere_else():
    # Blocks on both sides of the goal, nearer than the clearance of free motion.
    seen = map_of(CUBE, (-0.5, 0.11, 0.05, 0.05), (-0.5, -0.11, 0.05, 0.05))
    check_path(plan_action(GOAL, heightmap(), HOME, CONFIG), CONFIG, seen)
    T = tool_down(-0.5, 0.0, 0.01, 0.0)
    q = ur5e.inverse(T @ np.linalg.inv(rg2.T_FLANGE_TCP), HOME)
    assert q is not None
    with pytest.raises(Obstructed, match="fingers"):
        check_clearance(np.stack([HOME, q]), Tool(0.08), seen, CONFIG, "move")


def test_a_push_does_not_run_over_a_bottle():
    push = action("push", -0.5, -0.05, 0.05, 4)
    with pytest.raises(Obstructed):
        plan_way(push, heightmap(), map_of(CUBE, (-0.5, 0.03, 0.03, 0.25)), HOME, CONFIG)


def test_the_retreat_leads_around_what_was_seen_and_goes_high_where_nobody_looked():
    T = tool_down(-0.5, 0.0, 0.2, 0.0)
    q = ur5e.inverse(T @ np.linalg.inv(rg2.T_FLANGE_TCP), HOME)
    assert q is not None
    state = ArmState(0.0, q, np.zeros(6), ur5e.forward(q) @ rg2.T_FLANGE_TCP, np.zeros(6), ArmMode.READY)
    seen = map_of((-0.5, 0.12, 0.03, 0.28))
    checked = check_retreat(state, CONFIG, seen)
    assert_clear(checked, seen)
    blind = check_retreat(state, CONFIG, None)
    first = blind.plan.steps[0]
    assert isinstance(first, LinearMove)
    assert first.T_base_tcp[2, 3] >= 0.4


def test_an_arm_may_leave_a_place_that_it_is_too_near_to_something_in():
    seen = map_of((-0.45, 0.30, 0.05, 0.345))
    path = np.linspace(HOME, HOME + np.array([0.0, -0.3, 0.0, 0.3, 0.0, 0.0]), 20)
    check_clearance(path, Tool(0.08), seen, CONFIG, "away")
    with pytest.raises(UnsafeMotion):
        check_clearance(2 * HOME - path, Tool(0.08), seen, CONFIG, "down")
