"""The layer between every decision and every motion.

`check_plan` refuses a whole plan before anything moves; a `Guard` watches the arm while it moves. A violation
latches: until an operator asks for `recover`, nothing moves. This layer adds to the safety settings of the
controller and never replaces them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell import collision, kinematics, linkage
from robotcell.errors import DeviceFault, GuardTripped, UnsafeMotion
from robotcell.geometry import Array, interpolate_transforms, rotation_angle
from robotcell.interfaces import ArmMode, ArmState
from robotcell.primitives import CheckHold, Grip, JointMove, LinearMove, MotionPlan, flange_pose

if TYPE_CHECKING:
    from robotcell.config import CellConfig, KeepOut

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


@dataclass(frozen=True)
class CheckedPlan:
    """A plan that `check_plan` found safe; the only thing that the executor accepts."""

    plan: MotionPlan


def check_plan(plan: MotionPlan, config: CellConfig) -> CheckedPlan:
    """Check every step of a plan against every limit, from the joint angles it starts at.

    Reach, joint limits, singularities on straight lines, speeds, the box of the tcp, keep-outs, the table, the arm
    itself and the gripper's range; with the load where one is held. Where the arm stands at the start is a fact, not a
    plan: only where it goes is checked, so that it can leave a place that it should not be in.

    Raises:
        UnsafeMotion: the first violation, with the step, the place and the limit.
    """
    q = _joint_vector(plan.q_start, f"{plan.label}: start")
    obstacles = collision.obstacles(config)
    for step in plan.steps:
        name = f"{plan.label}, step {step.label!r}"
        if isinstance(step, Grip):
            _check_grip(step, name)
        elif isinstance(step, JointMove):
            goal = _joint_vector(step.q, name)
            _check_below(step.speed_rad_s, config.limits.joint_speed_rad_s, "joint speed", "rad/s", name)
            _check_below(
                step.acceleration_rad_s2,
                kinematics.MAX_JOINT_ACCELERATION,
                "joint acceleration",
                "rad/s2",
                name,
            )
            count = int(np.ceil(np.abs(goal - q).max() / _JOINT_STEP_RAD)) + 1
            path = q + np.linspace(0.0, 1.0, max(count, 2))[:, None] * (goal - q)
            _check_path(path[1:], step.load_m, obstacles, config, name)
            q = goal
        elif isinstance(step, LinearMove):
            path = _linear_path(q, step, config, name)
            _check_path(path[1:], step.load_m, obstacles, config, name)
            q = path[-1]
        elif not isinstance(step, CheckHold):
            raise TypeError(f"{name}: {type(step).__name__} is no step of a plan")
    return CheckedPlan(plan)


class Guard:
    """Watches the arm while it moves, and remembers a violation until an operator clears it."""

    def __init__(self, config: CellConfig) -> None:
        self._config = config
        self._violation: str | None = None

    @property
    def violation(self) -> str | None:
        """What tripped the guard, or None."""
        return self._violation

    def check_clear(self) -> None:
        """Raise GuardTripped if a violation is latched."""
        if self._violation:
            raise GuardTripped(f"nothing moves after a safety stop ({self._violation}); look at the cell, then recover")

    def check_start(self, state: ArmState, plan: MotionPlan) -> None:
        """Before a plan runs: nothing latched, the arm ready, and standing where the plan starts.

        Raises:
            GuardTripped: a violation is latched.
            DeviceFault: the arm is not ready.
            UnsafeMotion: the arm stands elsewhere.
        """
        self.check_clear()
        _check_ready(state)
        off = float(np.abs(state.q - plan.q_start).max())
        if off > _START_TOLERANCE_RAD:
            raise UnsafeMotion(
                f"{plan.label}: a joint is {off:.3f} rad from the start of the plan: plan again from measured joints"
            )

    def check(self, state: ArmState, now: float) -> None:
        """In every supervision period of a motion.

        Raises:
            GuardTripped: a limit is exceeded or the state is stale; latched.
            DeviceFault: the controller stopped the arm; latched.
        """
        limits = self._config.limits
        try:
            _check_ready(state)
        except DeviceFault as fault:
            self.trip(str(fault))
            raise
        age = now - state.t
        x, y, z = state.T_base_tcp[:3, 3]
        force = float(np.linalg.norm(state.wrench[:3]))
        joint_speed = float(np.abs(state.qd).max())
        tool_speed = float(np.linalg.norm((kinematics.jacobian(state.q) @ state.qd)[:3]))
        for exceeded, what in (
            (age > limits.state_age_s, f"the arm's state is {age:.2f} s old (limit {limits.state_age_s} s)"),
            (force > limits.force_n, f"the tool feels {force:.0f} N (limit {limits.force_n:.0f} N)"),
            (
                joint_speed > 1.05 * limits.joint_speed_rad_s,
                f"a joint turns at {joint_speed:.2f} rad/s (limit {limits.joint_speed_rad_s} rad/s)",
            ),
            (
                tool_speed > 1.05 * limits.tool_speed_m_s,
                f"the tool moves at {tool_speed:.2f} m/s (limit {limits.tool_speed_m_s} m/s)",
            ),
            (
                bool(_outside_box(state.T_base_tcp[None, :3, 3], self._config, slack_m=0.005)[0]),
                f"the tcp at x {x:.3f}, y {y:.3f}, z {z:.3f} m left its box",
            ),
        ):
            if exceeded:
                self.trip(what)
                raise GuardTripped(f"{what}; the arm was stopped: look at the cell, then recover")

    def trip(self, what: str) -> None:
        """Latch a violation."""
        self._violation = what

    def clear(self) -> None:
        """Forget the violation. Only ever called because an operator asked for it."""
        self._violation = None


def _check_ready(state: ArmState) -> None:
    if state.mode is not ArmMode.READY:
        raise DeviceFault(f"the arm is in {state.mode.value}; clear the cause at the cell, then recover")


def _check_grip(step: Grip, name: str) -> None:
    if not linkage.MIN_WIDTH_M <= step.width_m <= linkage.MAX_WIDTH_M:
        raise UnsafeMotion(f"{name}: width {1000 * step.width_m:.1f} mm is outside the gripper's 0 to 110 mm")
    if not linkage.MIN_FORCE_N <= step.force_n <= linkage.MAX_FORCE_N:
        raise UnsafeMotion(f"{name}: force {step.force_n:.1f} N is outside the gripper's 3 to 40 N")


def _joint_vector(q: Array, name: str) -> Array:
    vector = np.asarray(q, dtype=np.float64)
    if vector.shape != (6,) or not np.isfinite(vector).all():
        raise UnsafeMotion(f"{name}: joint angles {np.asarray(q).tolist()} are not six finite numbers")
    return vector


def _check_below(value: float, limit: float, what: str, unit: str, name: str) -> None:
    if not 0 < value <= limit:
        raise UnsafeMotion(f"{name}: {what} {value} {unit} is not within 0 and the limit of {limit} {unit}")


def _linear_path(q: Array, step: LinearMove, config: CellConfig, name: str) -> Array:
    """Joint angles (N, 6) along a straight motion; raises UnsafeMotion where the arm cannot follow."""
    _check_below(step.speed_m_s, config.limits.tool_speed_m_s, "tool speed", "m/s", name)
    _check_below(step.acceleration_m_s2, kinematics.MAX_TOOL_ACCELERATION, "tool acceleration", "m/s2", name)
    T_goal = np.asarray(step.T_base_tcp)
    if T_goal.shape != (4, 4) or not np.isfinite(T_goal).all():
        raise UnsafeMotion(f"{name}: the target is not a finite 4x4 transform")
    T_start = kinematics.forward(q) @ linkage.T_FLANGE_TCP
    length = float(np.linalg.norm(T_goal[:3, 3] - T_start[:3, 3]))
    angle = rotation_angle(T_start[:3, :3], T_goal[:3, :3])
    count = int(np.ceil(max(length / _LINEAR_STEP_M, angle / _ROTATION_STEP_RAD))) + 1
    T_path = interpolate_transforms(T_start, T_goal, np.linspace(0.0, 1.0, max(count, 2)))
    try:
        path = kinematics.inverse_along(flange_pose(T_path), q, _MAX_JOINT_JUMP_RAD)
    except ValueError as error:
        raise UnsafeMotion(f"{name}: {error}") from error
    distance = kinematics.distance_to_singularity(path)
    if distance.min() < config.limits.singularity:
        x, y, z = T_path[int(distance.argmin()), :3, 3]
        raise UnsafeMotion(
            f"{name}: too close to a singularity at tcp x {x:.3f}, y {y:.3f}, z {z:.3f} m "
            f"({distance.min():.3f}, limit {config.limits.singularity})"
        )
    # How long the fastest joint needs, at the tool speed of the step.
    if length > 0:
        seconds = (length / (count - 1)) / step.speed_m_s
        joint_speed = float(np.abs(np.diff(path, axis=0)).max()) / seconds
        _check_below(max(joint_speed, 1e-9), kinematics.MAX_JOINT_SPEED, "joint speed on the line", "rad/s", name)
    return path


def _check_path(path: Array, load_m: float, obstacles: tuple[KeepOut, ...], config: CellConfig, name: str) -> None:
    limits, table = config.limits, config.table.height_m
    margin = kinematics.JOINT_LIMIT - limits.joint_margin_rad
    if (np.abs(path) > margin).any():
        joint = int((np.abs(path) - margin).max(axis=0).argmax())
        raise UnsafeMotion(
            f"{name}: joint {joint} would turn to {path[np.abs(path[:, joint]).argmax(), joint]:.2f} rad "
            f"(limit +-{margin[joint]:.2f} rad)"
        )
    T_tcp = kinematics.forward(path) @ linkage.T_FLANGE_TCP
    tcp = T_tcp[:, :3, 3]
    outside = _outside_box(tcp, config, slack_m=_ROUNDING_M)
    if outside.any():
        x, y, z = tcp[int(outside.argmax())]
        raise UnsafeMotion(
            f"{name}: the tcp would leave its box at x {x:.3f}, y {y:.3f}, z {z:.3f} m "
            f"(limits x {limits.x}, y {limits.y}, z {limits.z} m)"
        )
    too_low = tcp[:, 2] < table + config.gripper.tip_clearance_m - _ROUNDING_M
    if too_low.any():
        z = tcp[:, 2].min() - table
        raise UnsafeMotion(
            f"{name}: the finger tips would be {1000 * z:.1f} mm above the table "
            f"(limit {1000 * config.gripper.tip_clearance_m:.1f} mm)"
        )
    centers = collision.sphere_centers(path)
    radius = collision.SPHERES.radius + limits.clearance_m
    # The base stands on the table.
    above = collision.SPHERES.group > 0
    if (centers[:, above, 2] - radius[above] < table).any():
        raise UnsafeMotion(f"{name}: the arm or the gripper's body would touch the table")
    points = collision.finger_points(T_tcp, load_m)
    for box in obstacles:
        body = (collision.box_distance(box, centers) < radius)[:, above]
        fingers = collision.box_distance(box, points) < limits.clearance_m
        if body.any() or fingers.any():
            raise UnsafeMotion(f"{name}: the arm, the gripper or its load would enter the keep-out {box.name!r}")
    if (collision.self_distance(centers) < limits.clearance_m).any():
        raise UnsafeMotion(f"{name}: the arm or the gripper would touch the arm itself")


def _outside_box(points: Array, config: CellConfig, slack_m: float) -> npt.NDArray[np.bool_]:
    limits = config.limits
    low, high = np.array([limits.x, limits.y, limits.z]).T
    return np.asarray(((points < low - slack_m) | (points > high + slack_m)).any(axis=1))
