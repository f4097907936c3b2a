"""The process of the physics: one pybullet world in real time, driven and read through shared memory."""

from __future__ import annotations

import signal
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import CellError
from sim_twin.devices.arm import JOINT_GAINS
from sim_twin.devices.gripper import TwinGripper
from sim_twin.options import TwinOptions
from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE, GRIPPER_COMMAND, PERIOD_S, Record, poses_dtype
from sim_twin.world import robot_model
from sim_twin.world.simulation import STEP_S
from sim_twin.world.world import World

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array

# A controller whose tick stands still for this long is dead: the brakes fall in.
_CONTROLLER_SILENCE_S = 0.05
# The joints follow this far behind the newest target, so that a world that is late now and then finds targets to follow
# and no jump: a jump would turn the joints faster than anybody told them to.
_FOLLOW_BEHIND_S = 0.008
# By how much faster the targets are passed through, per second that the world is behind.
_CATCH_UP_PER_S = 10.0
# Behind by less than this, the world catches up; by more, it leaves steps out.
_MAX_LAG_S = 0.1
# The poses of all visuals cost three steps of physics: at 60 Hz a frame of the camera is at most 17 ms behind.
_STEPS_PER_POSES = 4
_STEPS_PER_CHECK = 24


def serve_world(
    config: CellConfig,
    arm_command: str,
    gripper_command: str,
    cell_state: str,
    faults: Connection,
    ready: Connection,
) -> None:
    """Run a world until SIGTERM, or until the supervisor is gone.

    Args:
        config: the cell, its backend options those of a twin.
        arm_command: name of the record by which the UR controller drives the joints.
        gripper_command: name of the record by which the Compute Box drives the fingers.
        cell_state: name of the record of the world.
        faults: ends when the supervisor does; the physics itself has no faults.
        ready: gets {"poses": name of the record of all poses, "visuals": tuple of `Visual`}, or {"error": text}.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Signals that came. A plain list: one that comes while the handler of another runs must find no lock.
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    world = World(config, TwinOptions.model_validate(config.backend.options))
    commands = Record(ARM_COMMAND, arm_command)
    fingers = Record(GRIPPER_COMMAND, gripper_command)
    state = Record(CELL_STATE, cell_state)
    try:
        world.attach(state)
        gripper = TwinGripper(world)
        gripper.connect()
        poses = Record(poses_dtype(len(world.visuals())))
    except CellError as error:
        ready.send({"error": str(error)})
        return
    try:
        joints = _Joints(world, commands)
        world.add_controller(joints.control)
        loop = _Loop(world, gripper, fingers, joints, state, poses)
        loop.report()
        ready.send({"poses": poses.name, "visuals": world.visuals()})
        loop.run(ended, faults)
    finally:
        world.close()
        for record in (commands, fingers, state, poses):
            record.close()


class _Targets:
    """The controller's targets at the pace of the world's steps."""

    def __init__(self) -> None:
        # (time of the controller [s], joint angles), oldest first, and the time that the joints have got to.
        self._ahead: deque[tuple[float, Array]] = deque()
        self._time = 0.0

    def step(self, time_s: float, q: Array) -> Array:
        """The target of the next step; `time_s` and `q` are the controller's newest."""
        if not self._ahead:
            self._time = time_s
        if not self._ahead or time_s > self._ahead[-1][0]:
            self._ahead.append((time_s, q))
        newest = self._ahead[-1][0]
        pace = 1 + _CATCH_UP_PER_S * (newest - _FOLLOW_BEHIND_S - self._time)
        self._time = min(self._time + STEP_S * min(max(pace, 0.0), 2.0), newest)
        while len(self._ahead) > 1 and self._ahead[1][0] <= self._time:
            self._ahead.popleft()
        (begin, q_begin), (end, q_end) = self._ahead[0], self._ahead[min(1, len(self._ahead) - 1)]
        share = (self._time - begin) / (end - begin) if end > begin else 0.0
        return q_begin + max(share, 0.0) * (q_end - q_begin)

    def forget(self) -> None:
        """Begin anew with the next target."""
        self._ahead.clear()


class _Joints:
    """Holds the joints at what the controller commands, or by their brakes."""

    def __init__(self, world: World, commands: Record) -> None:
        self._world = world
        self._commands = commands
        self.joints = world.joint_index(robot_model.ARM_JOINTS)
        self._tick = -1
        self._heard_at = -np.inf
        self._targets = _Targets()
        # Where the brakes hold the arm, while they do.
        self._held: Array | None = None

    def control(self) -> None:
        """One control period."""
        command, now = self._commands.read(), time.monotonic()
        if command["tick"] != self._tick:
            self._tick, self._heard_at = int(command["tick"]), now
        if command["powered"] and now - self._heard_at < _CONTROLLER_SILENCE_S:
            self._held = None
            target = self._targets.step(self._tick * PERIOD_S, command["q"])
        else:
            if self._held is None:
                self._held, _ = self._world.joint_states(self.joints)
                self._targets.forget()
            target = self._held
        self._world.drive_positions(self.joints, target.tolist(), robot_model.JOINT_TORQUE_NM, JOINT_GAINS)


class _Loop:
    """Steps the world with the clock."""

    def __init__(
        self, world: World, gripper: TwinGripper, fingers: Record, joints: _Joints, state: Record, poses: Record
    ) -> None:
        self._world = world
        self._gripper = gripper
        self._fingers = fingers
        self._joints = joints
        self._state = state
        self._poses = poses
        self._gripper_count = 0
        # What both tips take of the opening; the Compute Box speaks of the bare fingers.
        self._tips_m = 2 * gripper.range().fingertip_offset_m
        self._steps = 0
        self._skipped = 0

    def run(self, ended: list[int], faults: Connection) -> None:
        """Until it is told to end, or nobody is there to tell it."""
        due = time.monotonic()
        while not ended:
            due += STEP_S
            wait = due - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            elif -wait > _MAX_LAG_S:
                left_out = int(-wait / STEP_S)
                self._skipped += left_out
                due += left_out * STEP_S
            self._drive_gripper()
            self._world.step()
            self._steps += 1
            self.report()
            if self._steps % _STEPS_PER_CHECK == 0 and not _supervised(faults):
                return

    def _drive_gripper(self) -> None:
        command = self._fingers.read()
        if command["count"] == self._gripper_count:
            return
        self._gripper_count = int(command["count"])
        if command["stop"]:
            self._gripper.stop()
        else:
            reach = self._gripper.range()
            width = min(max(float(command["width_m"]) - self._tips_m, reach.min_width_m), reach.max_width_m)
            self._gripper.start_width(width, float(command["force_n"]))

    def report(self) -> None:
        """Write down how things stand."""
        world, contact, gripper = self._world, self._world.contact(), self._gripper.state()
        q, qd = world.joint_states(self._joints.joints)
        wrench = contact.tool_wrench(world.flange()[:3, 3]) if len(contact.forces) else np.zeros(6)
        self._state.write(
            t=world.time_s,
            wall=time.monotonic(),
            q=q,
            qd=qd,
            wrench=wrench,
            robot_force=contact.robot_force,
            width_m=gripper.width_m + self._tips_m,
            busy=gripper.busy,
            grip_detected=gripper.grip_detected,
            gripper_count=self._gripper_count,
            skipped=self._skipped,
        )
        if self._steps % _STEPS_PER_POSES == 0:
            self._poses.write(t=world.time_s, poses=world.visual_poses())


def _supervised(faults: Connection) -> bool:
    """Whether the supervisor is there."""
    try:
        while faults.poll():
            faults.recv()
    except EOFError:
        return False
    return True
