from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.config import CellConfig
from robotcell.errors import ConfigError, UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.actions import plan_action
from robotcell.motion.config_check import check_config
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, JointMove, LinearMove, MotionPlan
from robotcell.motion.retreat import plan_retreat
from robotcell.motion.tool import tool_down
from tests.robotcell.maps import KINDS, action, heightmap

CONFIG = CellConfig()
HOME = np.array(CONFIG.motion.home_q)
TIPS = CONFIG.gripper.tip_clearance_m


def plan_of(*steps: Any) -> MotionPlan:
    return MotionPlan("test", HOME, steps)


def joint_move(q: Any, speed: float = 1.0, acceleration: float = 1.0, load_m: float = 0.0) -> JointMove:
    return JointMove("move", np.array(q), speed, acceleration, load_m)


def above(x: float, y: float, z: float) -> JointMove:
    """A joint move to a tool-down pose."""
    q = ur5e.inverse(tool_down(x, y, z, 0.0) @ np.linalg.inv(rg2.T_FLANGE_TCP), HOME)
    assert q is not None
    return joint_move(q)


def to(x: float, y: float, z: float, speed: float = 0.2) -> LinearMove:
    return LinearMove("line", tool_down(x, y, z, 0.0), speed, 1.0)


def state(**changes: Any) -> ArmState:
    measured = ArmState(
        t=0.0,
        q=HOME,
        qd=np.zeros(6),
        T_base_tcp=ur5e.forward(HOME) @ rg2.T_FLANGE_TCP,
        wrench=np.zeros(6),
        mode=ArmMode.READY,
    )
    return replace(measured, **changes)


@settings(max_examples=50)
@given(
    st.sampled_from(KINDS),
    st.floats(CONFIG.workspace.x[0], CONFIG.workspace.x[1]),
    st.floats(CONFIG.workspace.y[0], CONFIG.workspace.y[1]),
    st.floats(0.0, 0.1),
    st.integers(0, 15),
)
def test_every_action_in_the_workspace_has_a_safe_plan(kind: str, x: float, y: float, z: float, rotation: int) -> None:
    try:
        plan = plan_action(action(kind, x, y, z, rotation), heightmap(), HOME, CONFIG)
    except UnsafeMotion as error:
        assert kind == "push"
        assert "inside the workspace" in str(error)
        return
    assert check_path(plan, CONFIG).plan is plan


@pytest.mark.parametrize("x", [*CONFIG.workspace.x, -0.5])
@pytest.mark.parametrize("y", [*CONFIG.workspace.y, 0.0])
@pytest.mark.parametrize(("z", "first"), [(0.0, 0), (0.03, 1), (0.1, 2)])
def test_the_rim_of_the_workspace_is_as_good_as_its_middle(x: float, y: float, z: float, first: int) -> None:
    # Every third, others at other heights: each place sees all sixteen.
    for rotation in range(first, 16, 3):
        check_path(plan_action(action("grasp", x, y, z, rotation), heightmap(), HOME, CONFIG), CONFIG)


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        (joint_move([np.nan] * 6), "not six finite numbers"),
        (joint_move([0.0] * 5), "not six finite numbers"),
        (joint_move([*HOME[:5], 6.27]), r"joint 6 would turn to 6\.27 rad"),
        (joint_move(HOME, speed=2.5), "joint speed 2.5 rad/s"),
        (joint_move(HOME, acceleration=100.0), "joint acceleration 100"),
        (joint_move(HOME, speed=0.0), "joint speed 0 "),
        (Grip("grip", 0.12, 20.0), r"width 120\.0 mm"),
        (Grip("grip", 0.05, 50.0), r"force 50\.0 N"),
        (LinearMove("line", np.full((4, 4), np.nan), 0.1, 1.0), "NaN"),
    ],
)
def test_a_step_outside_the_limits_is_refused(step: Any, reason: str) -> None:
    with pytest.raises(UnsafeMotion, match=rf"test, step '\w+': .*{reason}"):
        check_path(plan_of(step), CONFIG)


def test_a_line_below_the_table_is_refused() -> None:
    with pytest.raises(UnsafeMotion, match=r"finger tips would be -?\d"):
        check_path(plan_of(above(-0.5, 0.0, 0.2), to(-0.5, 0.0, 0.001)), CONFIG)


def test_tips_may_go_as_low_as_a_plan_means_them_to() -> None:
    plan = plan_of(above(-0.5, 0.0, 0.2), to(-0.5, 0.0, -0.008))
    with pytest.raises(UnsafeMotion, match="finger tips"):
        check_path(plan, CONFIG)
    check_path(plan, CONFIG, lowest_tip_m=-0.010)


def test_a_checked_plan_carries_the_path_that_was_checked() -> None:
    plan = plan_of(above(-0.5, 0.0, 0.3), Grip("close", 0.0, 20.0), to(-0.5, 0.1, 0.2))
    checked = check_path(plan, CONFIG)
    assert len(checked.joint_paths) == len(plan.steps)
    start = HOME
    for step, path in zip(plan.steps, checked.joint_paths, strict=True):
        np.testing.assert_allclose(path[0], start, atol=1e-9)
        assert (len(path) == 1) == isinstance(step, Grip)
        assert np.abs(np.diff(path, axis=0)).max(initial=0) < 0.35
        start = path[-1]
    end = ur5e.forward(start) @ rg2.T_FLANGE_TCP
    np.testing.assert_allclose(end, tool_down(-0.5, 0.1, 0.2, 0.0), atol=1e-6)


def test_a_line_out_of_the_box_is_refused() -> None:
    with pytest.raises(UnsafeMotion, match="leave its box"):
        check_path(plan_of(above(-0.4, -0.4, 0.3), to(-0.4, -0.5, 0.3)), CONFIG)


def test_a_line_out_of_reach_is_refused() -> None:
    wide = CONFIG.model_copy(update={"limits": CONFIG.limits.model_copy(update={"x": (-3.0, 3.0)})})
    with pytest.raises(UnsafeMotion, match=r"cannot reach|singularity"):
        check_path(plan_of(above(-0.6, 0.0, 0.3), to(-1.2, 0.0, 0.3)), wide)


def test_a_line_into_the_bin_wall_is_refused() -> None:
    x, y = CONFIG.bin.center
    edge = y - CONFIG.bin.size[1] / 2
    with pytest.raises(UnsafeMotion, match="keep-out 'bin'"):
        check_path(plan_of(above(x, edge, 0.3), to(x, edge, 0.05)), CONFIG)


def test_a_configured_keep_out_is_kept_out_of() -> None:
    shelf = {"name": "shelf", "x": (-0.55, -0.45), "y": (-0.05, 0.05), "z": (0.0, 0.15)}
    config = CellConfig.model_validate({"keep_out": [shelf]})
    plan = plan_action(action("grasp", -0.5, 0.0, 0.05, 0), heightmap(), HOME, config)
    with pytest.raises(UnsafeMotion, match="keep-out 'shelf'"):
        check_path(plan, config)


def test_a_load_needs_room_below() -> None:
    shelf = {"name": "shelf", "x": (-0.60, -0.40), "y": (0.0, 0.05), "z": (0.0, 0.22)}
    config = CellConfig.model_validate({"keep_out": [shelf]})
    start, end = above(-0.5, -0.15, 0.3), above(-0.5, 0.15, 0.3)
    check_path(plan_of(start, end), config)
    with pytest.raises(UnsafeMotion, match="keep-out 'shelf'"):
        check_path(plan_of(start, replace(end, load_m=0.12)), config)


def test_an_arm_folded_into_itself_is_refused() -> None:
    folded = HOME.copy()
    folded[2] = 2.95
    with pytest.raises(UnsafeMotion, match="touch"):
        check_path(plan_of(joint_move(folded)), CONFIG)


def test_a_line_through_the_wrist_singularity_is_refused() -> None:
    # With the fifth joint at zero the fourth and the sixth axis fall together.
    q = HOME.copy()
    q[4] = 0.3
    T = ur5e.forward(q) @ rg2.T_FLANGE_TCP
    past = HOME.copy()
    past[4] = -0.3
    T_past = ur5e.forward(past) @ rg2.T_FLANGE_TCP
    wide = {"x": (-1, 1), "y": (-1, 1), "z": (0, 1.2)}
    config = CellConfig.model_validate({"limits": wide})
    T_goal = T.copy()
    T_goal[:3, :3] = T_past[:3, :3]
    with pytest.raises(UnsafeMotion, match=r"singularity|cannot reach"):
        check_path(plan_of(joint_move(q), LinearMove("line", T_goal, 0.1, 1.0)), config)


def test_a_retreat_from_above_the_table_is_safe() -> None:
    step = above(-0.5, 0.1, 0.01)
    low = state(q=step.q, T_base_tcp=ur5e.forward(step.q) @ rg2.T_FLANGE_TCP)
    plan = plan_retreat(low, CONFIG)
    check_path(plan, CONFIG)
    first = plan.steps[0]
    assert isinstance(first, LinearMove)
    assert first.T_base_tcp[2, 3] > 0.15


def test_a_retreat_from_too_low_is_safe_and_a_move_along_there_is_not() -> None:
    # Two millimetres above the table, one below the clearance of the tips.
    step = above(-0.5, 0.1, 0.002)
    low = state(q=step.q, T_base_tcp=ur5e.forward(step.q) @ rg2.T_FLANGE_TCP)
    check_path(plan_retreat(low, CONFIG), CONFIG)
    with pytest.raises(UnsafeMotion, match="finger tips"):
        check_path(MotionPlan("test", step.q, (to(-0.5, 0.0, 0.002),)), CONFIG)


def test_a_joint_move_that_would_sweep_the_tool_too_fast_is_refused() -> None:
    slow = CellConfig.model_validate({"limits": {"tool_speed_m_s": 0.25}})
    with pytest.raises(UnsafeMotion, match=r"the tool would move at .* lower motion\.joint_speed_rad_s"):
        check_path(plan_of(above(-0.5, 0.0, 0.3)), slow)


def test_a_line_that_would_turn_a_joint_too_fast_is_refused() -> None:
    slow = CellConfig.model_validate({"limits": {"joint_speed_rad_s": 0.3}, "motion": {"joint_speed_rad_s": 0.3}})
    start = replace(above(-0.3, 0.0, 0.3), speed_rad_s=0.3)
    with pytest.raises(UnsafeMotion, match="a joint would turn at"):
        check_path(plan_of(start, to(-0.3, 0.2, 0.3, speed=0.25)), slow)


@pytest.mark.parametrize("T", [np.zeros((4, 4)), np.diag([2.0, 1.0, 1.0, 1.0])])
def test_a_target_that_is_no_pose_is_refused(T: np.ndarray) -> None:
    with pytest.raises(UnsafeMotion, match="the target"):
        check_path(plan_of(LinearMove("line", T, 0.1, 1.0)), CONFIG)


@pytest.mark.parametrize(
    "box",
    [
        {"x": (-0.475, -0.452), "y": (-0.02, 0.02), "z": (0.0, 0.03)},
        {"x": (-0.49, -0.445), "y": (-0.06, 0.06), "z": (0.0, 0.03)},
        {"x": (-0.52, -0.51), "y": (-0.005, 0.005), "z": (0.0, 0.06)},
    ],
)
def test_no_finger_passes_through_a_small_keep_out(box: dict[str, Any]) -> None:
    config = CellConfig.model_validate({"keep_out": [{"name": "pin", **box}]})
    plan = plan_action(action("grasp", -0.5, 0.0, 0.05, 0), heightmap(), HOME, config)
    with pytest.raises(UnsafeMotion, match="keep-out 'pin'"):
        check_path(plan, config)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"motion": {"joint_speed_rad_s": 3.0}}, r"motion\.joint_speed_rad_s = 3\.0: above limits"),
        ({"motion": {"linear_speed_m_s": 0.9}, "limits": {"tool_speed_m_s": 0.8}}, r"motion\.linear_speed_m_s"),
        ({"motion": {"home_q": [100, 0, 0, 0, 0, 0]}}, r"motion\.home_q: joint 1 would turn to 100"),
        ({"motion": {"home_q": [-0.8370, -1.4768, 1.9, -1.3733, -1.5708, 0.7338]}}, "between the camera and the"),
        ({"workspace": {"x": (-2.0, -1.6)}}, r"workspace, corner x -2\.0.* leave its limits"),
        (
            {"bin": {"center": (0.9, 0.5)}, "limits": {"x": (-1, 1), "y": (-1, 1)}},
            r"bin\.center: out of the arm's reach",
        ),
        ({"motion": {"closing_force_n": 150}}, r"motion\.closing_force_n = 150\.0: above limits\.grip_force_n"),
        ({"limits": {"force_n": 20}}, r"motion\.contact_force_n = 30\.0: above limits\.force_n"),
        ({"keep_out": [{"name": "lamp", "x": (-1, 1), "y": (-1, 1), "z": (0.2, 0.4)}]}, "keep-out 'lamp'"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(settings: dict[str, Any], problem: str) -> None:
    config = CellConfig.model_validate(settings)
    with pytest.raises(ConfigError, match=problem):
        check_config(config)


@pytest.mark.parametrize("height", [-0.1, 0.0, 0.05])
def test_a_table_at_another_height_is_as_good(height: float) -> None:
    config = CellConfig.model_validate({"table": {"height_m": height}})
    check_config(config)
    for rotation in (0, 5):
        plan = plan_action(action("grasp", -0.6, 0.1, 0.05, rotation), heightmap(), HOME, config)
        check_path(plan, config)
