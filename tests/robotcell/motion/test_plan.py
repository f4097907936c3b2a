from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.config import CellConfig
from robotcell.errors import UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.bodies import blocks_view
from robotcell.motion.actions import plan_action
from robotcell.motion.grasp import HELD_AFTER_LIFT, LOAD_REACH_M
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import (
    Grip,
    JointMove,
    LinearMove,
    MotionPlan,
    Shape,
    Step,
    blended,
    guarded_move,
    joint_move,
)
from robotcell.motion.tool import TALLEST_OBJECT_M
from tests.robotcell.maps import KINDS, action, heightmap

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
    plan = plan_action(action("grasp", x, y, z, rotation), heightmap(), HOME, CONFIG)
    T = linear(plan, "descend guarded").T_base_tcp
    np.testing.assert_allclose(T[:2, 3], (x, y), atol=1e-6)
    assert T[2, 3] == pytest.approx(max(z - 0.04, CONFIG.gripper.tip_clearance_m), abs=1e-6)
    # The tool points down, and its jaw closes along theta, one way round or the other.
    np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-6)
    theta = 2 * math.pi * rotation / 16
    assert abs(T[:3, 0] @ (math.cos(theta), math.sin(theta), 0)) == pytest.approx(1, abs=1e-6)


@given(xs, ys, surfaces, rotations)
def test_a_grasp_lifts_straight_up_until_the_load_clears_the_bin(x: float, y: float, z: float, rotation: int) -> None:
    plan = plan_action(action("grasp", x, y, z, rotation), heightmap(), HOME, CONFIG)
    down, up = linear(plan, "descend guarded").T_base_tcp, linear(plan, "lift").T_base_tcp
    np.testing.assert_allclose(up[:2, 3], down[:2, 3], atol=1e-6)
    assert up[2, 3] >= down[2, 3] + CONFIG.motion.approach_m - 1e-6
    assert up[2, 3] - LOAD_REACH_M > CONFIG.bin.wall_height_m


def test_the_unguarded_descent_ends_above_what_stands_there() -> None:
    heights = np.zeros(CONFIG.workspace.shape, np.float32)
    x, y = CONFIG.workspace.position(112, 112)
    heights[110:114, 132:136] = 0.08  # a neighbour under one of the open fingers
    plan = plan_action(action("grasp", x, y, 0.05, 0), heightmap(heights), HOME, CONFIG)
    tips = linear(plan, "descend").T_base_tcp[2, 3] + rg2.tip_retraction(CONFIG.gripper.preshape_m)
    assert tips == pytest.approx(0.08 + 0.015, abs=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_not_seen_may_be_as_tall_as_the_tallest_object(kind: str) -> None:
    unseen = heightmap(np.full(CONFIG.workspace.shape, np.nan, np.float32))
    plan = plan_action(action(kind, -0.5, 0.0, 0.05, 3), unseen, HOME, CONFIG)
    opening = CONFIG.gripper.preshape_m if kind == "grasp" else 0.0
    tips = linear(plan, "descend").T_base_tcp[2, 3] + rg2.tip_retraction(opening)
    assert tips >= TALLEST_OBJECT_M


@given(xs, ys, rotations)
def test_a_push_goes_straight_and_stays_in_the_workspace(x: float, y: float, rotation: int) -> None:
    try:
        plan = plan_action(action("push", x, y, 0.05, rotation), heightmap(), HOME, CONFIG)
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
    (grip,) = (step for step in plan.steps if isinstance(step, Shape))
    assert grip.width_m == 0.0


@given(xs, ys, rotations)
def test_what_is_picked_is_let_go_well_inside_the_bin(x: float, y: float, rotation: int) -> None:
    plan = plan_action(action("grasp", x, y, 0.05, rotation), heightmap(), HOME, CONFIG)
    (carry,) = (step for step in plan.steps if isinstance(step, JointMove) and step.label == "carry to bin")
    tcp = (ur5e.forward(carry.q) @ rg2.T_FLANGE_TCP)[:3, 3]
    for value, center, side in zip(tcp, CONFIG.bin.center, CONFIG.bin.size, strict=False):
        assert abs(value - center) <= side / 4 + 1e-6
    assert tcp[2] > CONFIG.bin.wall_height_m + 0.1


def test_every_plan_ends_where_the_camera_sees_the_workspace() -> None:
    eye = CONFIG.camera.pose()[:3, 3]
    for kind in KINDS:
        plan = plan_action(action(kind, -0.5, 0.0, 0.05, 3), heightmap(), HOME, CONFIG)
        last = [step for step in plan.steps if isinstance(step, JointMove)][-1]
        space = CONFIG.workspace
        assert not blocks_view(last.q, eye, space.x, space.y, CONFIG.table.height_m, LOAD_REACH_M)


@given(xs, ys, rotations, rotations)
def test_from_over_the_bin_as_from_home_the_way_of_the_leading_joint_is_short(
    x: float, y: float, rotation: int, next_rotation: int
) -> None:
    plan = plan_action(action("grasp", x, y, 0.05, rotation), heightmap(), HOME, CONFIG)
    approach, carry = (step for step in plan.steps if isinstance(step, JointMove))
    (following, _) = (
        step
        for step in plan_action(action("grasp", x, y, 0.05, next_rotation), heightmap(), carry.q, CONFIG).steps
        if isinstance(step, JointMove)
    )
    # The jaw is symmetric: no joint turns by more than half a turn and what lies between the places.
    for q, q_next in ((HOME, approach.q), (approach.q, carry.q), (carry.q, following.q)):
        assert np.abs(q - q_next).max() < 0.6 * np.pi


def test_motions_that_touch_nothing_are_blended_and_all_others_come_to_rest() -> None:
    plan = plan_action(action("grasp", -0.5, 0.0, 0.05, 3), heightmap(), HOME, CONFIG)
    labels = [[plan.steps[i].label for i in group] for group in blended(plan.steps)]
    assert ["approach", "descend"] in labels
    assert ["lift", HELD_AFTER_LIFT, "carry to bin"] in labels
    assert ["descend guarded"] in labels
    assert ["close"] in labels


@pytest.mark.parametrize("after", ["guarded", "grip", "nothing"])
def test_a_motion_is_blended_with_free_motions_only(after: str) -> None:
    T = ur5e.forward(HOME) @ rg2.T_FLANGE_TCP
    steps: list[Step] = [joint_move("first", HOME, CONFIG, blend_m=0.02)]
    if after == "guarded":
        steps.append(guarded_move("second", T, CONFIG, 0.1))
    elif after == "grip":
        steps.append(Grip("second", 0.02, 20.0))
    with pytest.raises(UnsafeMotion, match="cannot be blended"):
        check_path(MotionPlan("test", HOME, tuple(steps)), CONFIG)


def test_a_target_out_of_reach_is_refused() -> None:
    with pytest.raises(UnsafeMotion, match=r"cannot reach x -1\.500"):
        plan_action(action("grasp", -1.5, 0.0, 0.05, 0), heightmap(), HOME, CONFIG)


def test_joint_targets_stay_near_home() -> None:
    plan = plan_action(action("grasp", -0.5, 0.0, 0.05, 0), heightmap(), HOME, CONFIG)
    for step in plan.steps:
        if isinstance(step, JointMove):
            assert np.abs(step.q - HOME).max() < np.pi
            assert (np.abs(step.q) < ur5e.JOINT_LIMIT).all()
