"""The layer between every decision and every motion.

`check_config` refuses a cell that cannot work, `check_plan` refuses a whole plan before anything moves, and a `Guard`
watches the arm while it moves. A violation latches: until an operator asks for `recover`, nothing moves. This layer
adds to the safety settings of the controller and never replaces them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.errors import ConfigError, DeviceFault, GuardTripped, UnsafeMotion
from robotcell.geometry import bodies, rg2, ur5e
from robotcell.geometry.transforms import Array, check_transform, interpolate_transforms, rotation_angle
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove, MotionPlan, flange_pose, tool_down

if TYPE_CHECKING:
    from robotcell.cell import Latch
    from robotcell.config.schema import CellConfig, KeepOut

# Distance between the samples of a checked path. A joint step of 0.04 rad moves the outstretched tcp by 40 mm.
_JOINT_STEP_RAD = 0.04
_LINEAR_STEP_M = 0.01
_ROTATION_STEP_RAD = 0.05
# Two neighbouring samples of a straight path whose joints differ by more lie across a singularity.
_MAX_JOINT_JUMP_RAD = 0.35
# The measured arm may be this far from where a plan starts (settled position error of a UR5e is far below it).
_START_TOLERANCE_RAD = 0.02
# Rounding of positions that lie on a limit.
_ROUNDING_M = 1e-6
# Measured speeds scatter about the commanded ones; a measured tcp overshoots its box by rounding and control error.
_SPEED_SLACK = 1.05
_BOX_SLACK_M = 0.005
# A time stamp may be ahead of the clock by what two clocks of one machine can differ.
_CLOCK_SLACK_S = 0.01
# The base and the turning shoulder stand on the table, or in it where the table is higher than the arm's base.
_STANDS_ON_TABLE = 2


@dataclass(frozen=True)
class CheckedPlan:
    """A plan that `check_plan` found safe; the only thing that the executor accepts."""

    plan: MotionPlan


def check_config(config: CellConfig) -> None:
    """Check that the parts of a configuration fit each other.

    Raises:
        ConfigError: naming everything that does not: speeds over their limits, a home pose that is unsafe or in the
            view of the camera, a workspace or a bin that the arm may not or cannot reach.
    """
    problems: list[str] = []
    motion, limits = config.motion, config.limits
    if motion.joint_speed_rad_s > limits.joint_speed_rad_s:
        problems.append(
            f"motion.joint_speed_rad_s = {motion.joint_speed_rad_s}: above limits.joint_speed_rad_s = "
            f"{limits.joint_speed_rad_s}"
        )
    for name in ("linear_speed_m_s", "guarded_speed_m_s"):
        if getattr(motion, name) > limits.tool_speed_m_s:
            problems.append(
                f"motion.{name} = {getattr(motion, name)}: above limits.tool_speed_m_s = {limits.tool_speed_m_s}"
            )
    home = np.array(motion.home_q)
    try:
        _check_path(home[None], 0.0, bodies.obstacles(config), config, "motion.home_q")
    except UnsafeMotion as error:
        problems.append(str(error))
    if bodies.blocks_view(home, config):
        problems.append("motion.home_q: the arm would stand between the camera and the workspace")
    z = config.table.height_m + motion.approach_m
    corners = {f"workspace, corner x {x}, y {y}": (x, y) for x, y in product(config.workspace.x, config.workspace.y)}
    for name, (x, y) in {**corners, "bin.center": config.bin.center}.items():
        if _outside_box(np.array([[x, y, z]]), config, _ROUNDING_M)[0]:
            problems.append(f"{name}: {1000 * motion.approach_m:.0f} mm above it the tcp would leave its limits")
            continue
        q = ur5e.inverse(flange_pose(tool_down(x, y, z, 0.0)), home)
        if q is None:
            problems.append(f"{name}: out of the arm's reach with the tool down")
            continue
        if motion.joint_speed_rad_s > limits.joint_speed_rad_s:
            continue
        way = JointMove(name, q, motion.joint_speed_rad_s, motion.joint_acceleration_rad_s2)
        try:
            _joint_path(home, way, config, f"the way from motion.home_q to {name}")
        except UnsafeMotion as error:
            problems.append(str(error))
    if problems:
        heading = f"the configuration does not fit together: {len(problems)} problem(s)"
        raise ConfigError("\n  ".join([heading, *problems]))


def check_plan(plan: MotionPlan, config: CellConfig) -> CheckedPlan:
    """Check every step of a plan against every limit, from the joint angles it starts at.

    Reach, joint limits, singularities on straight lines, speeds, the box of the tcp, keep-outs, the table, the arm
    itself and the gripper's range; with the load where one is held. Where the arm stands at the start is a fact, not a
    plan: only where it goes is checked, so that it can leave a place that it should not be in.

    Raises:
        UnsafeMotion: the first violation, with the step, the place and the limit.
    """
    q = _joint_vector(plan.q_start, f"{plan.label}: start")
    obstacles = bodies.obstacles(config)
    for step in plan.steps:
        name = f"{plan.label}, step {step.label!r}"
        if isinstance(step, Grip):
            _check_grip(step, name)
        elif isinstance(step, JointMove):
            path = _joint_path(q, step, config, name)
            _check_path(path[1:], step.load_m, obstacles, config, name)
            q = path[-1]
        elif isinstance(step, LinearMove):
            path = _linear_path(q, step, config, name)
            _check_path(path[1:], step.load_m, obstacles, config, name)
            q = path[-1]
        elif not isinstance(step, CheckHold):
            raise TypeError(f"{name}: {type(step).__name__} is no step of a plan")
    return CheckedPlan(plan)


class Guard:
    """Watches the arm while it moves; what it finds is latched in the cell."""

    def __init__(self, config: CellConfig, latch: Latch) -> None:
        self._config = config
        self._latch = latch

    def check_start(self, state: ArmState, now: float, plan: MotionPlan) -> None:
        """Before a plan runs: nothing latched, the arm within its limits, and standing where the plan starts.

        Raises:
            GuardTripped: a violation is latched, or the arm's state is stale or beyond a limit.
            DeviceFault: the arm is not ready.
            UnsafeMotion: the arm stands elsewhere.
        """
        self._latch.check()
        self._check_state(state, now)
        off = float(np.abs(state.q - plan.q_start).max())
        if not off <= _START_TOLERANCE_RAD:
            raise UnsafeMotion(
                f"{plan.label}: a joint is {off:.3f} rad from the start of the plan: plan again from measured joints"
            )

    def check(self, state: ArmState, now: float) -> None:
        """In every supervision period of a motion.

        Raises:
            GuardTripped: a limit is exceeded or the state is stale; latched.
            DeviceFault: the controller stopped the arm; latched.
        """
        try:
            self._check_state(state, now)
            x, y, z = state.T_base_tcp[:3, 3]
            if _outside_box(state.T_base_tcp[None, :3, 3], self._config, _BOX_SLACK_M)[0]:
                raise _tripped(f"the tcp at x {x:.3f}, y {y:.3f}, z {z:.3f} m left its box")
        except (DeviceFault, GuardTripped) as error:
            self._latch.trip(str(error))
            raise

    def _check_state(self, state: ArmState, now: float) -> None:
        """Freshness, mode, force and speeds; a number that is not one fails every comparison."""
        limits = self._config.limits
        if state.mode is not ArmMode.READY:
            raise DeviceFault(f"the arm is in {state.mode.value}; clear the cause at the cell, then recover")
        age = now - state.t
        if not -_CLOCK_SLACK_S <= age <= limits.state_age_s:
            raise _tripped(f"the arm's state is {age:.2f} s old (limit {limits.state_age_s} s)")
        if not (np.isfinite(state.q).all() and np.isfinite(state.T_base_tcp).all()):
            raise _tripped("the arm reports a position that is not a number")
        force = float(np.linalg.norm(state.wrench[:3]))
        joint_speed = float(np.abs(state.qd).max())
        tool_speed = float(ur5e.tool_speed(state.q, state.qd, rg2.CLOSED_LENGTH_M))
        for value, limit, what in (
            (force, limits.force_n, "the tool feels {:.0f} N (limit {:.0f} N)"),
            (
                joint_speed,
                _SPEED_SLACK * limits.joint_speed_rad_s,
                "a joint turns at {:.2f} rad/s (limit {:.2f} rad/s)",
            ),
            (tool_speed, _SPEED_SLACK * limits.tool_speed_m_s, "the tool moves at {:.2f} m/s (limit {:.2f} m/s)"),
        ):
            if not value <= limit:
                raise _tripped(what.format(value, limit))


def _tripped(what: str) -> GuardTripped:
    return GuardTripped(f"{what}; the arm is stopped: look at the cell, then recover")


def _check_grip(step: Grip, name: str) -> None:
    if not rg2.MIN_WIDTH_M <= step.width_m <= rg2.MAX_WIDTH_M:
        raise UnsafeMotion(f"{name}: width {1000 * step.width_m:.1f} mm is outside the gripper's 0 to 110 mm")
    if not rg2.MIN_FORCE_N <= step.force_n <= rg2.MAX_FORCE_N:
        raise UnsafeMotion(f"{name}: force {step.force_n:.1f} N is outside the gripper's 3 to 40 N")


def _joint_vector(q: Array, name: str) -> Array:
    vector = np.asarray(q, dtype=np.float64)
    if vector.shape != (6,) or not np.isfinite(vector).all():
        raise UnsafeMotion(f"{name}: joint angles {np.asarray(q).tolist()} are not six finite numbers")
    return vector


def _check_below(value: float, limit: float, what: str, unit: str, name: str) -> None:
    if not 0 < value <= limit:
        raise UnsafeMotion(f"{name}: {what} {value:.4g} {unit} is not within 0 and the limit of {limit:.4g} {unit}")


def _joint_path(q: Array, step: JointMove, config: CellConfig, name: str) -> Array:
    """Joint angles (N, 6) along a joint-space motion."""
    goal = _joint_vector(step.q, name)
    limits = config.limits
    _check_below(step.speed_rad_s, limits.joint_speed_rad_s, "joint speed", "rad/s", name)
    _check_below(step.acceleration_rad_s2, ur5e.MAX_JOINT_ACCELERATION, "joint acceleration", "rad/s2", name)
    way = float(np.abs(goal - q).max())
    count = max(int(np.ceil(way / _JOINT_STEP_RAD)) + 1, 2)
    path = q + np.linspace(0.0, 1.0, count)[:, None] * (goal - q)
    if way > 0:
        # A short motion never reaches its speed.
        peak = min(step.speed_rad_s, float(np.sqrt(step.acceleration_rad_s2 * way)))
        tool_speed = ur5e.tool_speed(path, (goal - q) / way * peak, rg2.CLOSED_LENGTH_M).max()
        if tool_speed > limits.tool_speed_m_s:
            raise UnsafeMotion(
                f"{name}: the tool would move at {tool_speed:.2f} m/s (limits.tool_speed_m_s = "
                f"{limits.tool_speed_m_s}); lower motion.joint_speed_rad_s"
            )
    return path


def _linear_path(q: Array, step: LinearMove, config: CellConfig, name: str) -> Array:
    """Joint angles (N, 6) along a straight motion; raises UnsafeMotion where the arm cannot follow."""
    limits = config.limits
    _check_below(step.speed_m_s, limits.tool_speed_m_s, "tool speed", "m/s", name)
    _check_below(step.acceleration_m_s2, ur5e.MAX_TOOL_ACCELERATION, "tool acceleration", "m/s2", name)
    try:
        T_goal = check_transform(step.T_base_tcp, "the target")
    except ValueError as error:
        raise UnsafeMotion(f"{name}: {error}") from error
    T_start = ur5e.forward(q) @ rg2.T_FLANGE_TCP
    length = float(np.linalg.norm(T_goal[:3, 3] - T_start[:3, 3]))
    angle = rotation_angle(T_start[:3, :3], T_goal[:3, :3])
    count = max(int(np.ceil(max(length / _LINEAR_STEP_M, angle / _ROTATION_STEP_RAD))) + 1, 2)
    T_path = interpolate_transforms(T_start, T_goal, np.linspace(0.0, 1.0, count))
    try:
        path = ur5e.inverse_along(flange_pose(T_path), q, _MAX_JOINT_JUMP_RAD)
    except ValueError as error:
        raise UnsafeMotion(f"{name}: {error}") from error
    distance = ur5e.distance_to_singularity(path)
    if distance.min() < limits.singularity:
        x, y, z = T_path[int(distance.argmin()), :3, 3]
        raise UnsafeMotion(
            f"{name}: too close to a singularity at tcp x {x:.3f}, y {y:.3f}, z {z:.3f} m "
            f"({distance.min():.3f}, limit {limits.singularity})"
        )
    # The time between samples at the speed of the step; a turn on the spot is as slow as the controller makes it.
    if length > 0:
        seconds = (length / (count - 1)) / step.speed_m_s
        joint_speed = float(np.abs(np.diff(path, axis=0)).max()) / seconds
        if joint_speed > limits.joint_speed_rad_s:
            raise UnsafeMotion(
                f"{name}: a joint would turn at {joint_speed:.2f} rad/s on the line "
                f"(limits.joint_speed_rad_s = {limits.joint_speed_rad_s}); go slower"
            )
    return path


def _check_path(path: Array, load_m: float, obstacles: tuple[KeepOut, ...], config: CellConfig, name: str) -> None:
    limits, table = config.limits, config.table.height_m
    margin = ur5e.JOINT_LIMIT - limits.joint_margin_rad
    if (np.abs(path) > margin).any():
        joint = int((np.abs(path) - margin).max(axis=0).argmax())
        raise UnsafeMotion(
            f"{name}: joint {joint} would turn to {path[np.abs(path[:, joint]).argmax(), joint]:.2f} rad "
            f"(limit +-{margin[joint]:.2f} rad)"
        )
    T_tcp = ur5e.forward(path) @ rg2.T_FLANGE_TCP
    tcp = T_tcp[:, :3, 3]
    too_low = tcp[:, 2] < table + config.gripper.tip_clearance_m - _ROUNDING_M
    if too_low.any():
        z = tcp[:, 2].min() - table
        raise UnsafeMotion(
            f"{name}: the finger tips would be {1000 * z:.1f} mm above the table "
            f"(limit {1000 * config.gripper.tip_clearance_m:.1f} mm)"
        )
    outside = _outside_box(tcp, config, slack_m=_ROUNDING_M)
    if outside.any():
        x, y, z = tcp[int(outside.argmax())]
        raise UnsafeMotion(
            f"{name}: the tcp would leave its box at x {x:.3f}, y {y:.3f}, z {z:.3f} m "
            f"(limits x {limits.x}, y {limits.y}, z {limits.z} m above the table)"
        )
    centers = bodies.sphere_centers(path)
    radius = bodies.SPHERES.radius + limits.clearance_m
    above = bodies.SPHERES.group >= _STANDS_ON_TABLE
    if (centers[:, above, 2] - radius[above] < table).any():
        raise UnsafeMotion(f"{name}: the arm or the gripper's body would touch the table")
    points = bodies.finger_points(T_tcp, load_m)
    for box in obstacles:
        body = (bodies.box_distance(box, centers) < radius)[:, bodies.SPHERES.group > 0]
        fingers = bodies.box_distance(box, points) < limits.clearance_m
        if body.any() or fingers.any():
            raise UnsafeMotion(f"{name}: the arm, the gripper or its load would enter the keep-out {box.name!r}")
    if (bodies.self_distance(centers) < limits.clearance_m).any():
        raise UnsafeMotion(f"{name}: the arm or the gripper would touch the arm itself")


def _outside_box(points: Array, config: CellConfig, slack_m: float) -> npt.NDArray[np.bool_]:
    limits = config.limits
    low, high = np.array([limits.x, limits.y, limits.z]).T
    relative = points - (0.0, 0.0, config.table.height_m)
    return np.asarray(((relative < low - slack_m) | (relative > high + slack_m)).any(axis=1))
