"""The twin's UR5e: position-controlled joints of limited torque that follow jerk-limited profiles.

It refuses what the controller refuses, and stops by itself where the controller does: on a contact force, on a joint
that cannot follow, on a line that its kinematics cannot follow, and when nobody supervises the motion.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import ConnectionLost, DeviceFault, UnsafeMotion
from robotcell.geometry import controller_ranges, rg2, ur5e
from robotcell.interfaces import KICK_TIMEOUT_S, Arm, ArmMode, ArmState, JointWaypoint, LinearWaypoint
from sim_twin.devices.arm_limits import (
    LEAVING_FORCE_N,
    PROTECTIVE_FORCE_N,
    STOP_DECELERATION_RAD_S2,
    TRACKING_ERROR_RAD,
)
from sim_twin.devices.motion import plan_motion
from sim_twin.devices.trajectory import slow_down
from sim_twin.world import robot_model
from sim_twin.world.simulation import STEP_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.findings import Finding
    from robotcell.interfaces import Array, Waypoint
    from sim_twin.world.world import World

# Share of the position error that each joint controller corrects within a step.
JOINT_GAINS = (0.5,) * 6


class TwinArm(Arm):
    """The `Arm` of a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._connected = False
        self._joints: list[int] = []
        self._mode = ArmMode.READY
        # The motion under way: (N, 6) joint angles, one per step, and the sample that was commanded last.
        self._path: Array = np.empty((0, 6))
        self._index = 0
        # Whether the path ends where the arm cannot follow the motion any further.
        self._breaks_off = False
        self._braking = False
        self._force_limit_n = PROTECTIVE_FORCE_N
        self._kicked_at = 0.0

    def connect(self) -> None:
        """Attach to the world and hold the arm where it is. Does nothing when connected."""
        if self._connected:
            return
        try:
            self._world.attach(self)
            self._joints = self._world.joint_index(robot_model.ARM_JOINTS)
            self._mode = ArmMode.READY
            self._hold()
            self._world.add_controller(self._control)
            self._connected = True
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the arm and let the world go. Idempotent, also when connecting was cut short."""
        if self._connected:
            self._hold()
        self._connected = False
        self._world.remove_controller(self._control)
        self._world.detach(self)

    @property
    def moving(self) -> bool:
        """Whether a motion, or the braking that ends it, is under way."""
        self._need_connection()
        return self._breaks_off or self._index < len(self._path) - 1

    def state(self) -> ArmState:
        """The state after the last step.

        The wrench is the sum of the contact forces on gripper and fingers, as the sensor in the flange reports them
        once the gripper's own weight is subtracted: a held object's weight is in it, the arm's inertia is not.
        """
        self._need_connection()
        q, qd = self._world.joint_states(self._joints)
        T_base_tcp = ur5e.forward(q) @ rg2.T_FLANGE_TCP
        return ArmState(
            t=self._world.time_s,
            q=q,
            qd=qd,
            T_base_tcp=T_base_tcp,
            wrench=self._world.contact().tool_wrench(T_base_tcp[:3, 3]),
            mode=self._mode,
        )

    def report(self) -> tuple[Finding, ...]:
        """Nothing: it has no settings of its own that could differ from the cell's."""
        self._need_connection()
        return ()

    def start_joints(self, q: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint-space motion; see `Arm`.

        Raises:
            UnsafeMotion: q is outside the joint limits or not six finite numbers, speed or acceleration are outside
                the controller's range, or the arm is moving.
            DeviceFault: the arm is stopped.
        """
        self.start_path((JointWaypoint(q, speed_rad_s, acceleration_rad_s2),))

    def start_linear(self, T_base_tcp: Array, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Start a straight motion of the tcp; see `Arm`.

        Where a pose on the way is out of reach, or a joint would have to leap, the arm comes that far and then makes a
        protective stop.

        Raises:
            UnsafeMotion: the pose is no rigid transform, speed or acceleration are outside the controller's range, or
                the arm is moving.
            DeviceFault: the arm is stopped.
        """
        self.start_path((LinearWaypoint(T_base_tcp, speed_m_s, acceleration_m_s2),))

    def start_path(self, waypoints: Sequence[Waypoint]) -> None:
        """Start a motion along several legs; see `Arm`. What `start_linear` says of lines holds for each.

        Raises:
            UnsafeMotion: a leg is outside the ranges, a blend radius too, or the arm is moving.
            DeviceFault: the arm is stopped.
        """
        self._need_ready()
        checked = controller_ranges.check_path_motion(waypoints)
        motion = plan_motion(self._path[-1], checked, rg2.T_FLANGE_TCP, STEP_S)
        if len(motion.q) or motion.breaks_off:
            self._start(motion.q, breaks_off=motion.breaks_off)

    def stop(self) -> None:
        """Brake along the path at `STOP_DECELERATION_RAD_S2`."""
        self._need_connection()
        if self.moving and not self._braking:
            rest = slow_down(self._path, self._index, STOP_DECELERATION_RAD_S2, STEP_S)
            self._path = np.vstack([self._path[self._index], rest])
            self._index = 0
            self._breaks_off = False
            self._braking = True

    def kick(self) -> None:
        """Keep the motion going: one that is not kicked for `KICK_TIMEOUT_S` of simulated time stops."""
        self._need_connection()
        self._kicked_at = self._world.time_s

    def recover(self) -> None:
        """Leave a protective stop; the next motion starts from where the joints are. Does nothing when ready."""
        self._need_connection()
        if self._mode is ArmMode.PROTECTIVE_STOP:
            self._hold()
            self._mode = ArmMode.READY

    def _start(self, path: Array, *, breaks_off: bool = False) -> None:
        self._path = np.vstack([self._path[-1], path])
        self._index = 0
        self._breaks_off = breaks_off
        self._braking = False
        # More than at the start, so that the arm can leave a contact that stopped it.
        at_start = _norm(self._world.contact().robot_force)
        self._force_limit_n = max(PROTECTIVE_FORCE_N, at_start + LEAVING_FORCE_N)
        self._kicked_at = self._world.time_s

    def _control(self) -> None:
        """One control period: watch, also an arm at rest; then command the next sample."""
        if self._mode is ArmMode.READY and self._must_protect():
            self._hold()
            self._mode = ArmMode.PROTECTIVE_STOP
        if self.moving and not self._braking and self._world.time_s - self._kicked_at > KICK_TIMEOUT_S:
            self.stop()
        if self._index < len(self._path) - 1:
            self._index += 1
            self._command(self._path[self._index])

    def _must_protect(self) -> bool:
        if self._breaks_off and self._index == len(self._path) - 1:
            return True
        if _norm(self._world.contact().robot_force) > self._force_limit_n:
            return True
        q, _ = self._world.joint_states(self._joints)
        return float(np.abs(q - self._path[self._index]).max()) > TRACKING_ERROR_RAD

    def _hold(self) -> None:
        q, _ = self._world.joint_states(self._joints)
        self._path = q[None]
        self._index = 0
        self._breaks_off = False
        self._braking = False
        self._command(q)

    def _command(self, q: Array) -> None:
        self._world.drive_positions(self._joints, q.tolist(), robot_model.JOINT_TORQUE_NM, JOINT_GAINS)

    def _need_connection(self) -> None:
        if not self._connected:
            raise ConnectionLost("the twin's arm is not connected: connect it first")

    def _need_ready(self) -> None:
        self._need_connection()
        if self._mode is not ArmMode.READY:
            raise DeviceFault(
                f"the arm is in {self._mode.value}: look at the cell, clear the contact, then run robotcell recover"
            )
        if self.moving:
            raise UnsafeMotion("the arm is still moving: wait until the motion has ended, or stop it")


def _norm(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
