"""The gripper on two slides instead of an arm: what a grasp or a push does to the objects, at a tenth of the cost.

For training, where only the outcome of an attempt counts and not the way there. World, gripper, speeds of the fingers
and forces are those of the twin; the arm's links and its way to the bin are left out. Several attempts can be made
from the same state, since a state can be saved and put back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.fingers import closed_width, narrowest_hold
from robotcell.geometry import rg2
from robotcell.geometry.transforms import invert_transform
from robotcell.motion.executor import Ending
from robotcell.motion.tool import tool_down
from sim_twin.devices.gripper import TwinGripper
from sim_twin.devices.trajectory import trapezoid
from sim_twin.world import robot_model
from sim_twin.world.bodies import is_at_rest, put_body, put_to_sleep, quaternion
from sim_twin.world.settling import is_in_workspace
from sim_twin.world.simulation import STEP_S
from sim_twin.world.world import World

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from sim_twin.options import TwinOptions
    from sim_twin.scenes.scene import Scene
    from sim_twin.world.bodies import Friction
    from sim_twin.world.simulation import Simulation

# Of the motor that stands in for the arm; an arm gives way at about this force at its tool.
_SLIDE_FORCE_N = 200.0
_GAIN = 0.5
# Half as fast again as a cell's default: a finger that lands on an object is stopped by 30 N either way.
_GUARDED_SPEED_M_S = 0.12
_LIFT_M = 0.10
# After the lift the load is carried: swung along the closing axis with about the arm's acceleration.
_SWING_M = 0.012
_SWING_S = 0.30
_SWINGS = 1
# An object that rose by this share of the lift is held.
_HELD_SHARE = 0.5
_FINGERS_STEPS = 360
_PARKED_Z = 1.5
_SETTLE_STEPS = 12
_SETTLES = 20
# Objects that were taken away lie here, asleep.
_AWAY = (5.0, 5.0, -1.0)

_T_TCP_FLANGE = invert_transform(rg2.T_FLANGE_TCP)


@dataclass(frozen=True)
class Attempt:
    """What an attempt came to.

    Attributes:
        ending: DONE, CONTACT when something was in the way of the fingers, EMPTY when they closed on nothing.
        held: indices of the objects that are held at the end of a grasp; none where what was gripped got lost.
    """

    ending: Ending
    held: tuple[int, ...] = ()


class GantryGripper:
    """The gripper on two slides, in a world of its own; it is parked out of sight between attempts.

    Args:
        config: of the cell.
        options: of the twin; the scene is taken from `scene` instead.
        scene: what stands on the table.
        friction: of objects and table.
    """

    def __init__(self, config: CellConfig, options: TwinOptions, scene: Scene, friction: Friction) -> None:
        self.config = config
        self.world = World(config, options, friction, robot_model.gantry_machine(options.fingertip_offset_m), scene)
        self._gripper = TwinGripper(self.world)
        self._taken: set[int] = set()
        self._slides: list[int] = []
        self._fingers: dict[int, str] = {}
        # Where the slides are: along, down [m].
        self._at = (0.0, 0.0)

    def connect(self) -> None:
        """Build the world and park the gripper.

        Raises:
            ConfigError: the scene does not come to rest in the workspace.
        """
        self._gripper.connect()
        self._slides = self.world.joint_index((robot_model.SLIDE_X, robot_model.SLIDE_Z))
        names = tuple(robot_model.finger_angles(0.0))
        self._fingers = dict(zip(self.world.joint_index(names), names, strict=True))
        self._taken = set()
        self._park()

    def close(self) -> None:
        """End the world. Idempotent."""
        self._gripper.close()
        self.world.close()

    @property
    def present(self) -> list[int]:
        """Indices of the objects that are still on the table."""
        return [i for i in range(len(self.world.simulation.bodies)) if i not in self._taken]

    def grasp(self, x: float, y: float, theta: float, near_z: float, tcp_z: float) -> Attempt:
        """Come down at (x, y), close along theta, lift and swing.

        Args:
            x: where [m].
            y: likewise.
            theta: closing direction about base z [rad].
            near_z: height of the tcp [m] at which the descent begins.
            tcp_z: at which it ends.
        """
        use = self.config.gripper
        self._place(x, y, near_z, theta, use.preshape_m)
        if not self._slide(0.0, near_z - tcp_z, _GUARDED_SPEED_M_S, guarded=True):
            return Attempt(Ending.CONTACT)
        self._gripper.start_width(closed_width(self.config), use.force_n)
        for _ in range(_FINGERS_STEPS):
            self.world.step()
            if not self._gripper.state().busy:
                break
        if self._gripper.state().width_m < narrowest_hold(self.config):
            return Attempt(Ending.EMPTY)
        heights = self._heights()
        self._slide(0.0, near_z - tcp_z - _LIFT_M, self.config.motion.linear_speed_m_s, guarded=False)
        self._swing(near_z - tcp_z - _LIFT_M)
        rose = self._heights() - heights
        held = tuple(int(i) for i in np.flatnonzero(rose > _HELD_SHARE * _LIFT_M))
        lost = self._gripper.state().width_m < narrowest_hold(self.config) or not held
        return Attempt(Ending.DONE, () if lost else held)

    def push(self, start: tuple[float, float], theta: float, length_m: float, near_z: float, tcp_z: float) -> Attempt:
        """Come down at start (x, y) with closed fingers and move by `length_m` along theta; arguments as in `grasp`."""
        self._place(*start, near_z, theta, closed_width(self.config))
        if not self._slide(0.0, near_z - tcp_z, _GUARDED_SPEED_M_S, guarded=True):
            return Attempt(Ending.CONTACT)
        self._slide(length_m, near_z - tcp_z, _GUARDED_SPEED_M_S, guarded=True)
        return Attempt(Ending.DONE)

    def withdraw(self) -> None:
        """Take the gripper away and let the objects come to rest."""
        self._park()
        simulation = self.world.simulation
        for _ in range(_SETTLES):
            self.world.step(_SETTLE_STEPS)
            if all(is_at_rest(simulation, simulation.bodies[i]) for i in self.present):
                break

    def take(self, indices: tuple[int, ...]) -> None:
        """Remove objects from the table."""
        simulation = self.world.simulation
        for i in indices:
            if i not in self._taken:
                self._taken.add(i)
                x, y, z = _AWAY
                _move(simulation, simulation.bodies[i], (x + 0.3 * i, y, z), (0.0, 0.0, 0.0, 1.0))

    def drop_outs(self) -> tuple[int, ...]:
        """Objects that left the workspace or fell off the table."""
        simulation, config = self.world.simulation, self.config
        return tuple(i for i in self.present if not is_in_workspace(simulation, simulation.bodies[i], config))

    def save(self) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
        """Where every object is; they are taken to be at rest."""
        simulation = self.world.simulation
        place_of, client = simulation.engine.getBasePositionAndOrientation, simulation.client
        return [place_of(body, physicsClientId=client) for body in simulation.bodies]

    def restore(self, saved: list[tuple[tuple[float, ...], tuple[float, ...]]]) -> None:
        """Put every object back to where it was, at rest and asleep, and park the gripper."""
        simulation = self.world.simulation
        self._park()
        for body, (position, turn) in zip(simulation.bodies, saved, strict=True):
            now = simulation.engine.getBasePositionAndOrientation(body, physicsClientId=simulation.client)
            if now != (position, turn):
                _move(simulation, body, position, turn)
        self._taken = {i for i in self._taken if saved[i][0][2] < 0 and saved[i][0][0] > 1}

    def _park(self) -> None:
        self._place(0.0, 0.0, _PARKED_Z, 0.0, self.config.gripper.preshape_m)

    def _place(self, x: float, y: float, z: float, theta: float, width_m: float) -> None:
        """Put the gripper somewhere at once, its fingers so far open."""
        simulation = self.world.simulation
        p, client = simulation.engine, simulation.client
        T_base_flange = tool_down(x, y, z, theta) @ _T_TCP_FLANGE
        position = T_base_flange[:3, 3].tolist()
        p.resetBasePositionAndOrientation(simulation.robot, position, quaternion(T_base_flange), physicsClientId=client)
        angles = robot_model.finger_angles(rg2.crank_angle(width_m + 2 * self.world.gripper_range.fingertip_offset_m))
        for joint, name in self._fingers.items():
            p.resetJointState(simulation.robot, joint, angles[name], physicsClientId=client)
        for joint in self._slides:
            p.resetJointState(simulation.robot, joint, 0.0, physicsClientId=client)
        self._drive(0.0, 0.0)
        self._gripper.stop()
        self._at = (0.0, 0.0)

    def _slide(self, along: float, down: float, speed_m_s: float, *, guarded: bool) -> bool:
        """Move the slides straight to (along, down) [m]; False when guarded and something resisted."""
        start, way = np.array(self._at), np.array([along, down]) - self._at
        distance = float(np.linalg.norm(way))
        limit = self.config.motion.contact_force_n
        for i, s in enumerate(trapezoid(distance, speed_m_s, self.config.motion.linear_acceleration_m_s2, STEP_S)):
            x, z = start + way * (s / distance)
            self._drive(float(x), float(z))
            self.world.step()
            # The executor looks at the force every 8 ms, which is every second step.
            if guarded and i % 2 and math.hypot(*self.world.contact().robot_force) > limit:
                return False
        self._at = (along, down)
        return True

    def _swing(self, down: float) -> None:
        for i in range(round(_SWINGS * _SWING_S / STEP_S)):
            # Begins and ends at rest.
            along = _SWING_M * 0.5 * (1 - math.cos(2 * math.pi * i * STEP_S / _SWING_S))
            self._drive(along, down)
            self.world.step()

    def _drive(self, along: float, down: float) -> None:
        self.world.drive_positions(self._slides, (along, down), (_SLIDE_FORCE_N,) * 2, (_GAIN,) * 2)

    def _heights(self) -> Array:
        return np.array([position[2] for position, _ in self.save()])


def _move(simulation: Simulation, body: int, position: Sequence[float], turn: Sequence[float]) -> None:
    """Put an object somewhere at once, asleep."""
    put_body(simulation, body, position, turn)
    put_to_sleep(simulation, body)
