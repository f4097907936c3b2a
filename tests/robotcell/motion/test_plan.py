from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.config import CellConfig
from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.jobs.policy_api import Primitive
from robotcell.motion.grasp import LOAD_REACH_M
from robotcell.motion.tool import TALLEST_OBJECT_M
from robotcell.motion.plan import Grip, JointMove, LinearMove, MotionPlan, plan_action
from tests.robotcell.maps import action, heightmap

CONFIG = CellConfig()
HOME = np.array(CONFIG.motion.home_q)
xs = st.floats(CONFIG.workspace.x[0], CONFIG.workspace.x[1])
ys = st.floats(CONFIG.workspace.y[0], CONFIG.workspace.y[1])
surfaces = st.floats(0.0, 0.15)
rotations = st.integers(0, 15)


def linear(plan: MotionPlan, label: str) -> LinearMove:
    (step,) = (step for step in plan.steps if isinstance(step, LinearMove) and step.label == label)
    return step


@given(xs, ys, surfaces, rotations)
def test_a_grasp_closes_below_the_surface_and_above_the_table(x: float, y: float, z: float, rotation: int) -> None:
    plan = plan_action(action(Primitive.GRASP, x, y, z, rotation), heightmap(), HOME, CONFIG)
    T = linear(plan, "descend guarded").T_base_tcp
    np.testing.assert_allclose(T[:2, 3], (x, y), atol=1e-6)
    assert T[2, 3] == pytest.approx(max(z - 0.04, CONFIG.gripper.tip_clearance_m), abs=1e-6)
    # The tool points down, and its jaw closes along theta, one way round or the other.
    np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-6)
    theta = 2 * math.pi * rotation / 16
    assert abs(T[:3, 0] @ (math.cos(theta), math.sin(theta), 0)) == pytest.approx(1, abs=1e-6)


@given(xs, ys, surfaces, rotations)
def test_a_grasp_lifts_straight_up_until_the_load_clears_the_bin(x: float, y: float, z: float, rotation: int) -> None:
    plan = plan_action(action(Primitive.GRASP, x, y, z, rotation), heightmap(), HOME, CONFIG)
    down, up = linear(plan, "descend guarded").T_base_tcp, linear(plan, "lift").T_base_tcp
    np.testing.assert_allclose(up[:2, 3], down[:2, 3], atol=1e-6)
    assert up[2, 3] >= down[2, 3] + CONFIG.motion.approach_m - 1e-6
    assert up[2, 3] - LOAD_REACH_M > CONFIG.bin.wall_height_m


def test_the_unguarded_descent_ends_above_what_stands_there() -> None:
    heights = np.zeros(CONFIG.workspace.shape, np.float32)
    x, y = CONFIG.workspace.position(112, 112)
    heights[110:114, 132:136] = 0.08  # a neighbour under one of the open fingers
    plan = plan_action(action(Primitive.GRASP, x, y, 0.05, 0), heightmap(heights), HOME, CONFIG)
    tips = linear(plan, "descend").T_base_tcp[2, 3] + rg2.tip_retraction(CONFIG.gripper.preshape_m)
    assert tips == pytest.approx(0.08 + 0.015, abs=1e-3)


@pytest.mark.parametrize("primitive", Primitive)
def test_what_was_not_seen_may_be_as_tall_as_the_tallest_object(primitive: Primitive) -> None:
    unseen = heightmap(np.full(CONFIG.workspace.shape, np.nan, np.float32))
    plan = plan_action(action(primitive, -0.5, 0.0, 0.05, 3), unseen, HOME, CONFIG)
    opening = CONFIG.gripper.preshape_m if primitive is Primitive.GRASP else 0.0
    tips = linear(plan, "descend").T_base_tcp[2, 3] + rg2.tip_retraction(opening)
    assert tips >= TALLEST_OBJECT_M


@given(xs, ys, rotations)
def test_a_push_goes_straight_and_stays_in_the_workspace(x: float, y: float, rotation: int) -> None:
    try:
        plan = plan_action(action(Primitive.PUSH, x, y, 0.05, rotation), heightmap(), HOME, CONFIG)
    except UnsafeMotion as error:
        assert "inside the workspace" in str(error)
        return
    start, end = linear(plan, "descend guarded").T_base_tcp, linear(plan, "push").T_base_tcp
    assert start[2, 3] == end[2, 3] == pytest.approx(0.025, abs=1e-6)
    travel = end[:2, 3] - start[:2, 3]
    length = np.linalg.norm(travel)
    assert length <= CONFIG.motion.push_m + 1e-6
    theta = 2 * math.pi * rotation / 16
    np.testing.assert_allclose(travel / length, (math.cos(theta), math.sin(theta)), atol=1e-4)
    for T in (start, end):
        assert CONFIG.workspace.x[0] - 1e-6 <= T[0, 3] <= CONFIG.workspace.x[1] + 1e-6
        assert CONFIG.workspace.y[0] - 1e-6 <= T[1, 3] <= CONFIG.workspace.y[1] + 1e-6
    (grip,) = (step for step in plan.steps if isinstance(step, Grip))
    assert grip.width_m == 0.0


@given(xs, ys, rotations)
def test_what_is_picked_is_let_go_well_inside_the_bin(x: float, y: float, rotation: int) -> None:
    plan = plan_action(action(Primitive.GRASP, x, y, 0.05, rotation), heightmap(), HOME, CONFIG)
    (carry,) = (step for step in plan.steps if isinstance(step, JointMove) and step.label == "carry to bin")
    tcp = (ur5e.forward(carry.q) @ rg2.T_FLANGE_TCP)[:3, 3]
    for value, center, side in zip(tcp, CONFIG.bin.center, CONFIG.bin.size, strict=False):
        assert abs(value - center) <= side / 4 + 1e-6
    assert tcp[2] > CONFIG.bin.wall_height_m + 0.1


def test_every_plan_ends_at_home() -> None:
    for primitive in Primitive:
        plan = plan_action(action(primitive, -0.5, 0.0, 0.05, 3), heightmap(), HOME, CONFIG)
        last = plan.steps[-1]
        assert isinstance(last, JointMove)
        np.testing.assert_array_equal(last.q, HOME)


def test_a_target_out_of_reach_is_refused() -> None:
    with pytest.raises(UnsafeMotion, match=r"cannot reach x -1\.500"):
        plan_action(action(Primitive.GRASP, -1.5, 0.0, 0.05, 0), heightmap(), HOME, CONFIG)


def test_joint_targets_stay_near_home() -> None:
    plan = plan_action(action(Primitive.GRASP, -0.5, 0.0, 0.05, 0), heightmap(), HOME, CONFIG)
    for step in plan.steps:
        if isinstance(step, JointMove):
            assert np.abs(step.q - HOME).max() < np.pi
            assert (np.abs(step.q) < ur5e.JOINT_LIMIT).all()
