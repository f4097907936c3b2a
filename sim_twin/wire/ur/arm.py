"""The arm of the UR controller: the joint target of each period, its kinematics, and what was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from ur_analytic_ik import ur5e as analytic_ik

from robotcell.geometry import ur5e
from robotcell.geometry.transforms import invert_transform, matrix_to_rotvec
from sim_twin.devices.arm_limits import MAX_TARGET_SPEED_RAD_S, STOP_DECELERATION_RAD_S2
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.pose import ZERO_POSE, Pose, displaced, matrix_to_pose, pose_to_matrix
from sim_twin.wire.ur.program import ScriptError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.interfaces import Array
    from sim_twin.wire.ur.force_mode import ForceMode

# Two targets of neighbouring periods may differ by this much.
_MAX_STEP_RAD = MAX_TARGET_SPEED_RAD_S * PERIOD_S
# Inverse kinematics is exact to this many digits; an arm that follows them stands still.
_STEADY_RAD_S = 1e-5


class Arm:
    """The joint targets of the arm, and what was measured.

    Args:
        q: (6,) joint angles [rad] at the start.

    Attributes:
        q: (6,) the joint target [rad] of this period.
        qd: (6,) its speed [rad/s].
        qdd: (6,) its acceleration [rad/s^2].
        measured_q, measured_qd: (6,) of the joints [rad, rad/s].
        wrench: (6,) force [N] and torque [N m] on the tool, base axes, about the flange.
        tcp_wrench: (6,) the same about the tcp, less what the sensor was zeroed at.
        rate: how much motion time passes per period, 0 to 1: slider and pause.
        tcp: pose of the tool centre point in the flange.
        freedrive: whether the targets follow the joints.
        force_mode: what the tool gives way to, None when it is stiff.
        reachable: whether inverse kinematics finds anything; a fault can take it away.
        arrives: whether a move ever ends; a fault can take it away.
        waypoint: (6,) where the move under way, or the last one, leads.
    """

    def __init__(self, q: Array) -> None:
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros(6)
        self.qdd = np.zeros(6)
        self.measured_q = self.q.copy()
        self.measured_qd = np.zeros(6)
        self.wrench = np.zeros(6)
        self.tcp_wrench = np.zeros(6)
        self.rate = 1.0
        self.freedrive = False
        self.force_mode: ForceMode | None = None
        self.reachable = True
        self.arrives = True
        self.waypoint = self.q
        self.tcp: Pose = ZERO_POSE
        self.set_tcp(ZERO_POSE)
        self._zero_wrench = np.zeros(6)
        # The speed with which a motion was left; braking starts from it.
        self._momentum = np.zeros(6)
        self._commanded = False
        self._before = self.q.copy()

    @property
    def steady(self) -> bool:
        """Whether the target stands still."""
        return bool(max(np.abs(self._momentum).max(), np.abs(self.qd).max()) < _STEADY_RAD_S)

    @property
    def momentum(self) -> Array:
        """(6,) joint speed [rad/s] of the motion under way; zero once it has ended."""
        return self._momentum

    def set_tcp(self, tcp: Sequence[float]) -> None:
        """Take another tool centre point."""
        self.tcp = (tcp[0], tcp[1], tcp[2], tcp[3], tcp[4], tcp[5])
        self.T_flange_tcp = pose_to_matrix(tcp)
        self._T_tcp_flange = invert_transform(self.T_flange_tcp)

    def flange(self, q: Array) -> Array:
        """T_base_flange of joint angles (6,); a tenth of the time of `ur5e.forward`."""
        return np.asarray(analytic_ik.forward_kinematics(*q))

    def forward(self, q: Array) -> Array:
        """T_base_tcp of joint angles (6,)."""
        return np.asarray(self.flange(q) @ self.T_flange_tcp)

    def tcp_pose(self, q: Array) -> Pose:
        """The pose of the tcp at joint angles (6,)."""
        return matrix_to_pose(self.forward(q))

    def inverse(self, T_base_tcp: Array, q_near: Array) -> Array:
        """The joint angles (6,) nearest to `q_near` that reach a pose of the tcp.

        Raises:
            ScriptError: there are none.
        """
        q = ur5e.inverse(T_base_tcp @ self._T_tcp_flange, q_near) if self.reachable else None
        if q is None:
            x, y, z = T_base_tcp[:3, 3]
            raise ScriptError(f"get_inverse_kin: cannot find a solution for x {x:.4f}, y {y:.4f}, z {z:.4f} m")
        return q

    def twist(self, q: Array, qd: Array) -> Array:
        """(6,) speed of the tcp [m/s, rad/s] in base axes, of joint angles and speeds."""
        if not qd.any():
            return np.zeros(6)
        h = 1e-6
        T, T_next = self.forward(q), self.forward(q + h * qd)
        w = matrix_to_rotvec(T_next[:3, :3] @ T[:3, :3].T)
        return np.concatenate([T_next[:3, 3] - T[:3, 3], w]) / h

    def measure(self, q: Array, qd: Array, wrench: Array) -> None:
        """Take in what was measured of the joints, each (6,), and of the wrench about the flange (6,)."""
        self.measured_q, self.measured_qd, self.wrench = q, qd, wrench
        self.tcp_wrench = self._wrench_at_tcp() - self._zero_wrench

    def zero_wrench(self) -> None:
        """Count from here what the sensor reads now."""
        self._zero_wrench = self._wrench_at_tcp()

    def command(self, q: Array) -> None:
        """Set the target of this period.

        Raises:
            ScriptError: another motion has set it already, or a joint would have to turn faster than it can.
        """
        if self._commanded:
            raise ScriptError("another thread is already controlling the robot")
        step = np.abs(q - self.q)
        # A step that is no number is refused too.
        if not step.max() <= _MAX_STEP_RAD:
            joint = int(step.argmax())
            raise ScriptError(
                f"joint {joint + 1} would have to turn at {step[joint] / PERIOD_S:.1f} rad/s: the path is too close to "
                "a singularity, or the arm is not where the motion was left"
            )
        self._commanded = True
        self.q = q
        self._momentum = (q - self._before) / PERIOD_S

    def rest(self) -> None:
        """Say that the motion has ended where it should."""
        self._momentum = np.zeros(6)

    def hold(self) -> None:
        """Take the joints, as they are, for the target."""
        self.q = self.measured_q.copy()
        self._before = self.q.copy()
        self._momentum = np.zeros(6)

    def finish_period(self) -> None:
        """Complete the target of this period: give way where that is asked for, brake where no motion is under way."""
        if self.freedrive and not self._commanded:
            self.hold()
        elif not self._commanded:
            self.q, self._momentum = braked(self.q, self._momentum, STOP_DECELERATION_RAD_S2, PERIOD_S)
        if self.force_mode is not None:
            self._give_way(self.force_mode)
        qd = (self.q - self._before) / PERIOD_S
        self.qdd = (qd - self.qd) / PERIOD_S
        self.qd = qd
        self._before = self.q.copy()
        self._commanded = False

    def _wrench_at_tcp(self) -> Array:
        if not self.wrench.any():
            return self.wrench
        arm = self.flange(self.measured_q)[:3, :3] @ self.T_flange_tcp[:3, 3]
        fx, fy, fz, tx, ty, tz = self.wrench.tolist()
        x, y, z = arm.tolist()
        return np.array([fx, fy, fz, tx - (y * fz - z * fy), ty - (z * fx - x * fz), tz - (x * fy - y * fx)])

    def _give_way(self, mode: ForceMode) -> None:
        T = self.forward(self.q)
        twist = mode.twist(self.tcp_wrench)
        if not twist.any():
            return
        try:
            q = self.inverse(displaced(T, twist * PERIOD_S), self.q)
        except ScriptError:
            return
        if np.abs(q - self.q).max() <= _MAX_STEP_RAD:
            self.q = q


def braked(q: Array, momentum: Array, deceleration: float, period: float) -> tuple[Array, Array]:
    """Target and speed after one period of braking along a straight line in joint space."""
    speed = float(np.abs(momentum).max())
    if speed == 0:
        return q, momentum
    after = max(0.0, speed - deceleration * period)
    return q + momentum * (0.5 * (speed + after) / speed * period), momentum * (after / speed)
