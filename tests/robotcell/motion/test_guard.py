"""The guard: what it lets pass, what it stops, and that it sees a stop's way ahead."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.config import CellConfig
from robotcell.errors import DeviceFault, GuardTripped, UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.course import Course, Phase, course_of, standing
from robotcell.motion.guard import Guard, Latch
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import LinearMove, MotionPlan, joint_move
from robotcell.motion.tool import flange_pose, tool_down

CONFIG = CellConfig()
HOME = np.array(CONFIG.motion.home_q)
TIPS = CONFIG.gripper.tip_clearance_m
START = MotionPlan("test", HOME, ())
PERIOD_S = 0.008


def state(q: Any = HOME, **changes: Any) -> ArmState:
    q = np.asarray(q, np.float64)
    measured = ArmState(
        t=0.0,
        q=q,
        qd=np.zeros(6),
        T_base_tcp=ur5e.forward(q) @ rg2.T_FLANGE_TCP,
        wrench=np.zeros(6),
        mode=ArmMode.READY,
    )
    return replace(measured, **changes)


def pose(x: float, y: float, z: float) -> np.ndarray:
    """Joint angles of a tool that points down there."""
    q = ur5e.inverse(flange_pose(tool_down(x, y, z, 0.0)), HOME)
    assert q is not None
    return q


def course(q: Any = HOME, phase: Phase = Phase.FREE, lowest_tip_m: float = TIPS, **changes: Any) -> Course:
    """Of an arm that is about to stay where it is, or to go along a path."""
    return Course("move", phase, np.atleast_2d(q), 0.1, lowest_tip_m, **changes)


def watching(config: CellConfig = CONFIG, at: Course | None = None, latch: Latch | None = None, **start: Any) -> Guard:
    """A guard that has begun a course at its first sample."""
    at = at or course()
    guard = Guard(config, latch or Latch())
    guard.begin(at, state(at.path[0], **start))
    return guard


def pushed(force_n: float) -> np.ndarray:
    return np.array([0.0, 0.0, force_n, 0.0, 0.0, 0.0])


def test_a_plan_starts_where_the_arm_stands() -> None:
    guard = Guard(CONFIG, Latch())
    guard.check_start(state(), 0.0, START)
    with pytest.raises(UnsafeMotion, match="plan again from measured joints"):
        guard.check_start(state(q=HOME + 0.1), 0.0, START)
    with pytest.raises(DeviceFault, match="emergency stop"):
        guard.check_start(state(mode=ArmMode.EMERGENCY_STOP), 0.0, START)
    with pytest.raises(GuardTripped, match="old"):
        guard.check_start(state(), 100.0, START)
    with pytest.raises(GuardTripped, match="not a number"):
        guard.check_start(state(q=np.full(6, np.nan)), 0.0, START)


@pytest.mark.parametrize(
    ("changes", "now", "error", "reason"),
    [
        ({}, 0.3, GuardTripped, r"0\.30 s old"),
        ({"t": 1000.0}, 0.0, GuardTripped, "old"),
        ({"t": float("nan")}, 0.0, GuardTripped, "old"),
        ({"wrench": np.array([0.0, 0.0, 120.0, 0, 0, 0])}, 0.0, GuardTripped, "120 N"),
        ({"wrench": np.full(6, np.nan)}, 0.0, GuardTripped, "feels nan"),
        ({"qd": np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.5])}, 0.0, GuardTripped, r"2\.50 rad/s"),
        ({"qd": np.full(6, np.nan)}, 0.0, GuardTripped, "turns at nan"),
        ({"qd": np.array([2.0, 2.0, 2.0, 2.0, 0.0, 0.0])}, 0.0, GuardTripped, "tool moves at"),
        ({"T_base_tcp": tool_down(-0.9, 0.0, 0.3, 0.0)}, 0.0, GuardTripped, "outside its box"),
        ({"T_base_tcp": np.full((4, 4), np.nan)}, 0.0, GuardTripped, "not a number"),
        ({"mode": ArmMode.PROTECTIVE_STOP}, 0.0, DeviceFault, "protective stop"),
    ],
)
def test_a_violation_latches_until_an_operator_clears_it(
    changes: dict[str, Any], now: float, error: type[Exception], reason: str
) -> None:
    latch = Latch()
    guard = watching(latch=latch)
    guard.check(state(), 0.0)
    with pytest.raises(error, match=reason):
        guard.check(state(**changes), now)
    with pytest.raises(GuardTripped, match="recover"):
        Guard(CONFIG, latch).check_start(state(), 0.0, START)
    latch.clear()
    guard.check_start(state(), 0.0, START)


def test_the_tool_is_judged_by_the_speed_of_its_tip() -> None:
    # The second wrist joint moves the tip, not the flange's middle, through most of its way.
    slow = CellConfig.model_validate({"limits": {"tool_speed_m_s": 0.5}})
    wrist = np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0])
    with pytest.raises(GuardTripped, match=r"tool moves at 0\.6"):
        watching(slow).check(state(qd=wrist), 0.0)


def test_tips_may_go_as_low_as_a_plan_means_them_to() -> None:
    q = pose(-0.5, 0.0, -0.008)
    above = pose(-0.5, 0.0, 0.05)
    watching(at=course([above, q], lowest_tip_m=-0.010)).check(state(q), 0.0)
    with pytest.raises(GuardTripped, match="outside its box"):
        watching(at=course([above, q])).check(state(q), 0.0)


@pytest.mark.parametrize(
    ("phase", "passes_n", "stops_n"),
    [(Phase.FREE, 24.0, 51.0), (Phase.CARRY, 99.0, 101.0), (Phase.GUARDED, 99.0, 101.0), (Phase.GRIP, 139.0, 141.0)],
)
def test_an_impact_stops_by_what_is_to_be_touched(phase: Phase, passes_n: float, stops_n: float) -> None:
    guard = watching(at=course(phase=phase))
    for period in range(200):
        now = period * PERIOD_S
        guard.check(state(t=now, wrench=pushed(passes_n)), now)
    with pytest.raises(GuardTripped, match=f"{stops_n:.0f} N.*{phase.value}"):
        guard.check(state(t=now, wrench=pushed(stops_n)), now)


def test_a_slow_rise_where_nothing_is_to_be_touched_stops_before_it_is_high() -> None:
    guard = watching()
    # 30 N/s: the limit for an impact is reached after 1.7 s.
    rising = [(period * PERIOD_S, 30.0 * period * PERIOD_S) for period in range(200)]
    before = [(now, force) for now, force in rising if now < 1.1]
    for now, force in before:
        guard.check(state(t=now, wrench=pushed(force)), now)
    with pytest.raises(GuardTripped, match="where nothing is to be touched"):
        guard.check(state(t=1.2, wrench=pushed(36.0)), 1.2)


def test_a_jolt_that_passes_is_none() -> None:
    guard = watching()
    for period in range(400):
        now = period * PERIOD_S
        # 40 N for 0.2 s, then nothing for as long.
        guard.check(state(t=now, wrench=pushed(40.0 if period // 25 % 2 else 0.0)), now)


def test_an_arm_may_leave_what_it_presses_on_but_not_press_harder() -> None:
    pressed = {"wrench": pushed(90.0)}
    leaving = watching(**pressed)
    for period, force in enumerate((95.0, 100.0, 60.0, 30.0, 10.0)):
        leaving.check(state(t=period * PERIOD_S, wrench=pushed(force)), period * PERIOD_S)
    # It has left it: what it meets now is new.
    with pytest.raises(GuardTripped):
        leaving.check(state(t=0.05, wrench=pushed(60.0)), 0.05)
    with pytest.raises(GuardTripped):
        watching(**pressed).check(state(wrench=pushed(115.0)), 0.0)
    stuck = watching(**pressed)
    for now in (0.0, 0.5, 0.9):
        stuck.check(state(t=now, wrench=pushed(90.0)), now)
    with pytest.raises(GuardTripped, match=r"for 1\.1 s"):
        stuck.check(state(t=1.1, wrench=pushed(90.0)), 1.1)


def test_the_limit_that_the_file_sets_holds_in_every_phase_but_a_grip() -> None:
    low = CellConfig.model_validate({"limits": {"force_n": 30}, "motion": {"contact_force_n": 25}})
    for phase in (Phase.FREE, Phase.CARRY, Phase.GUARDED):
        with pytest.raises(GuardTripped, match="limit 30 N"):
            watching(low, course(phase=phase)).check(state(wrench=pushed(31.0)), 0.0)


def test_fingers_open_before_the_guard_stops_them() -> None:
    # They open at 70 N over what the arm felt before them; an arm that presses with 40 N then feels 110 N.
    guard = watching(at=standing("close", HOME, TIPS), wrench=pushed(40.0))
    guard.check(state(wrench=pushed(112.0)), 0.0)


WALL = {"name": "wall", "x": (-0.52, -0.48), "y": (0.10, 0.14), "z": (0.0, 0.4)}


def sweep(speed: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles and speeds of a tool at x -0.5, 0.25 m over the table, that moves along y."""
    q, beside = pose(-0.5, y, 0.25), pose(-0.5, y + 1e-4, 0.25)
    return q, (beside - q) / 1e-4 * speed


def test_a_keep_out_is_seen_as_far_ahead_as_the_arm_needs_to_stand() -> None:
    config = CellConfig.model_validate({"keep_out": [WALL]})

    far = pose(-0.5, -0.3, 0.25)

    def trips(speed: float, y: float) -> bool:
        q, qd = sweep(speed, y)
        try:
            watching(config, course([far, q])).check(state(q, qd=qd), 0.0)
        except GuardTripped as error:
            assert "keep-out 'wall'" in str(error)
            return True
        return False

    def nearest(speed: float) -> float:
        """How far along y the arm gets at a speed."""
        low, high = -0.3, 0.1
        while high - low > 5e-4:
            y = 0.5 * (low + high)
            low, high = (low, y) if trips(speed, y) else (y, high)
        return low

    stands = nearest(0.0)
    # The way of the reaction and of a brake of 10 m/s^2; the brake is that of the joint that turns fastest.
    for speed in (0.2, 0.5, 1.0):
        assert 0.02 * speed < stands - nearest(speed) < 0.04 * speed + speed**2 / 10


def test_the_box_of_the_tcp_is_seen_ahead_as_well() -> None:
    config = CellConfig.model_validate({"limits": {"y": (-0.45, 0.10)}})
    for y, speed, passes in ((0.08, 0.1, True), (0.08, 1.0, False), (0.0, 1.0, True), (0.08, -1.0, True)):
        q, qd = sweep(speed, y)
        guard = watching(config, course(q))
        if passes:
            guard.check(state(q, qd=qd), 0.0)
        else:
            with pytest.raises(GuardTripped, match=r"would stand at .* outside its box"):
                guard.check(state(q, qd=qd), 0.0)


def test_an_arm_that_stands_where_it_should_not_may_leave_and_not_go_deeper() -> None:
    inside, deeper, out = pose(-0.5, 0.12, 0.25), pose(-0.5, 0.13, 0.25), pose(-0.5, -0.25, 0.25)
    config = CellConfig.model_validate({"keep_out": [WALL], "limits": {"y": (-0.45, 0.10)}})
    way = course([deeper, inside, out])
    guard = Guard(config, Latch())
    guard.begin(way, state(inside))
    guard.check(state(inside), 0.0)
    with pytest.raises(GuardTripped, match="outside its box"):
        guard.check(state(deeper), 0.0)
    guard.begin(way, state(inside))
    guard.check(state(out), 0.0)
    # It has left the keep-out: it stays out.
    with pytest.raises(GuardTripped, match="keep-out"):
        guard.check(state(pose(-0.5, 0.07, 0.25)), 0.0)


@given(share=st.floats(0, 1), off=st.floats(0.11, 0.5), joint=st.integers(0, 5))
def test_an_arm_beside_its_path_is_stopped_wherever_it_is(share: float, off: float, joint: int) -> None:
    q_end = pose(-0.5, 0.1, 0.3)
    at = course([HOME, 0.5 * (HOME + q_end), q_end])
    assert at.distance(HOME + share * (q_end - HOME)) == pytest.approx(0.0, abs=1e-9)
    beside = HOME + share * (q_end - HOME)
    beside[joint] += off
    # The path itself goes on in every joint: what is off by one of them is nearer to another place on it.
    assert at.distance(beside) <= off + 1e-9
    if at.distance(beside) > at.off_rad:
        with pytest.raises(GuardTripped, match="from the path that was checked"):
            watching(at=at).check(state(beside), 0.0)


def test_what_is_touched_follows_from_the_step() -> None:
    path = HOME[None]
    free = joint_move("approach", HOME, CONFIG)
    held = joint_move("carry", HOME, CONFIG, load_m=0.06)
    guarded = LinearMove("push", np.eye(4), 0.1, 1.0, contact_force_n=30.0)
    phases = [course_of([step], path, TIPS).phase for step in (free, held, guarded)]
    assert phases == [Phase.FREE, Phase.CARRY, Phase.GUARDED]
    assert course_of([held], path, TIPS).load_m == 0.06


@settings(max_examples=6)
@given(st.integers(0, 1000))
def test_no_motion_of_a_checked_path_trips_where_it_brakes_as_planned(seed: int) -> None:
    """A motion from home to anywhere over the workspace and down to the table, with the profile of the controller."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.7, -0.3), rng.uniform(-0.2, 0.2)
    q_above = pose(x, y, 0.2)
    steps = (
        joint_move("approach", q_above, CONFIG),
        LinearMove("descend", tool_down(x, y, TIPS, 0.0), 0.4, 1.2),
    )
    try:
        checked = check_path(MotionPlan("test", HOME, steps), CONFIG)
    except UnsafeMotion:
        return
    guard = Guard(CONFIG, Latch())
    for step, path in zip(steps, checked.joint_paths, strict=True):
        guard.begin(course_of([step], path, TIPS), state(path[0]))
        way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=1))])
        t, ramp = np.linspace(0, 1, 60), 0.25
        s = np.interp(t, [0, ramp, 1 - ramp, 1], [0, 0.15, 0.85, 1]) * way[-1]
        q = np.stack([np.interp(s, way, path[:, k]) for k in range(6)], axis=1)
        # Over 1.6 s: speeds near the limits of the plan.
        qd = np.gradient(q, 1.6 / len(t), axis=0)
        for q_now, qd_now in zip(q[1:-1], qd[1:-1], strict=True):
            guard.check(state(q_now, qd=qd_now), 0.0)
