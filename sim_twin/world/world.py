"""The twin's world: one simulation that arm, gripper, camera and clock of a cell share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import ConnectionLost
from robotcell.geometry import rg2
from sim_twin.world import robot_model
from sim_twin.world.bodies import (
    Friction,
    is_at_rest,
    link_poses,
    load_furniture,
    load_machine,
    object_pose,
    put_to_sleep,
)
from sim_twin.world.contacts import NO_CONTACT, Contact, measure_contact
from sim_twin.world.settling import QUIET_SLICES, SETTLE_SLICE, load_scene
from sim_twin.world.simulation import STEP_S, Simulation, start_simulation
from sim_twin.world.surfaces import carrier_poses, fixed_surfaces, object_surfaces, robot_surfaces

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import GripperRange
    from sim_twin.options import TwinOptions
    from sim_twin.scenes.scene import Scene, SceneObject
    from sim_twin.visual import Visual
    from sim_twin.world.robot_model import Machine
    from sim_twin.world.surfaces import Carrier


class World:
    """One cell in the engine. It exists while at least one device is attached; each life starts from the scene.

    Args:
        config: of the cell.
        options: of the twin.
        friction: of objects and table.
        machine: what carries the gripper; the arm unless given.
        scene: what stands on the table, in the base frame; that of the options unless given.
    """

    def __init__(
        self,
        config: CellConfig,
        options: TwinOptions,
        friction: Friction | None = None,
        machine: Machine | None = None,
        scene: Scene | None = None,
    ) -> None:
        self.config = config
        self._options = options
        self._friction = friction or Friction()
        self._machine = machine or robot_model.arm_machine(config.motion.home_q, options.fingertip_offset_m)
        self._given_scene = scene
        self._devices: list[object] = []
        self._controllers: list[Callable[[], None]] = []
        self._simulation: Simulation | None = None
        self._objects: tuple[SceneObject, ...] = ()
        self._visuals: tuple[Visual, ...] = ()
        self._carriers: tuple[Carrier, ...] = ()
        # For how many slices in a row each object has been at rest.
        self._quiet: list[int] = []
        self._steps = 0
        self._contact: tuple[int, Contact] = (-1, NO_CONTACT)

    @property
    def gripper_range(self) -> GripperRange:
        """What the gripper reaches with its tips."""
        return rg2.range_with_tips(self._options.fingertip_offset_m)

    @property
    def time_s(self) -> float:
        """Simulated seconds since the world was made; stands still while nothing is attached."""
        return self._steps * STEP_S

    @property
    def simulation(self) -> Simulation:
        """The engine and the bodies in it.

        Raises:
            ConnectionLost: nothing is attached.
        """
        return self._need_simulation()

    def attach(self, device: object) -> None:
        """Keep the world alive for a device; the first one builds it.

        Raises:
            ConfigError: the scene cannot be loaded, or does not come to rest in the workspace.
        """
        if self._simulation is None:
            self._build()
        if not any(known is device for known in self._devices):
            self._devices.append(device)

    def detach(self, device: object) -> None:
        """Forget a device; the last one ends the engine."""
        self._devices = [known for known in self._devices if known is not device]
        if not self._devices:
            self.close()

    def close(self) -> None:
        """End the engine. Idempotent."""
        simulation, self._simulation = self._simulation, None
        self._devices, self._controllers = [], []
        self._contact = (-1, NO_CONTACT)
        if simulation is not None:
            simulation.end()

    def add_controller(self, controller: Callable[[], None]) -> None:
        """Call `controller` before every step."""
        self._controllers.append(controller)

    def remove_controller(self, controller: Callable[[], None]) -> None:
        """Call it no longer."""
        self._controllers = [known for known in self._controllers if known != controller]

    def step(self, n: int = 1) -> None:
        """Advance by `n` steps of `STEP_S`.

        Raises:
            ConnectionLost: nothing is attached.
        """
        simulation = self.simulation
        step, client = simulation.engine.stepSimulation, simulation.client
        for _ in range(n):
            for controller in self._controllers:
                controller()
            step(client)
            self._steps += 1
            if self._steps % SETTLE_SLICE == 0:
                self._let_sleep()

    def joint_index(self, names: Sequence[str]) -> list[int]:
        """The engine's numbers of joints, see `robot_model`."""
        return [self.simulation.joints[name] for name in names]

    def joint_states(self, joints: Sequence[int]) -> tuple[Array, Array]:
        """Angles and speeds (N,) of joints [rad, rad/s]."""
        simulation = self.simulation
        states = simulation.engine.getJointStates(simulation.robot, joints, physicsClientId=simulation.client)
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])

    def drive_positions(
        self, joints: Sequence[int], angles: Sequence[float], torques: Sequence[float], gains: Sequence[float]
    ) -> None:
        """Hold joints at angles [rad] with at most `torques` [N m]; `gains` is the error corrected per step, 0..1."""
        simulation = self.simulation
        simulation.engine.setJointMotorControlArray(
            simulation.robot,
            joints,
            simulation.engine.POSITION_CONTROL,
            targetPositions=angles,
            forces=torques,
            positionGains=gains,
            physicsClientId=simulation.client,
        )

    def drive_speeds(self, joints: Sequence[int], speeds: Sequence[float], torques: Sequence[float]) -> None:
        """Turn joints at speeds [rad/s] with at most `torques` [N m]."""
        simulation = self.simulation
        simulation.engine.setJointMotorControlArray(
            simulation.robot,
            joints,
            simulation.engine.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=torques,
            physicsClientId=simulation.client,
        )

    def flange(self) -> Array:
        """T_base_flange (4, 4)."""
        return np.asarray(link_poses(self.simulation, [self.simulation.joints["flange"]])[0])

    def contact(self) -> Contact:
        """What touched arm and gripper in the last step."""
        if self._contact[0] != self._steps:
            self._contact = (self._steps, measure_contact(self.simulation))
        return self._contact[1]

    def visuals(self) -> tuple[Visual, ...]:
        """Everything that a camera can see; constant while the world lives.

        Raises:
            ConnectionLost: nothing is attached.
        """
        self._need_simulation()
        return self._visuals

    def visual_poses(self) -> Array:
        """T_base_visual (K, 4, 4) now, in the order of `visuals`."""
        return carrier_poses(self.simulation, self._carriers)

    def objects(self) -> list[tuple[SceneObject, Array]]:
        """Every object of the scene and its T_base_object (4, 4) now: for scoring only."""
        simulation = self.simulation
        return [(o, object_pose(simulation, body)) for o, body in zip(self._objects, simulation.bodies, strict=True)]

    def in_bin(self, index: int) -> bool:
        """Whether the centre of an object lies in the bin, below its rim."""
        x, y, z = object_pose(self.simulation, self.simulation.bodies[index])[:3, 3]
        (cx, cy), (sx, sy) = self.config.bin.center, self.config.bin.size
        rim = self.config.table.height_m + self.config.bin.wall_height_m
        return bool(abs(x - cx) < sx / 2 and abs(y - cy) < sy / 2 and z < rim)

    def _need_simulation(self) -> Simulation:
        if self._simulation is None:
            raise ConnectionLost("the twin is not connected: open the cell, or connect the device, first")
        return self._simulation

    def _build(self) -> None:
        config, options = self.config, self._options
        scene = self._given_scene or _scene(config, options)
        simulation = self._simulation = start_simulation()
        try:
            table = load_furniture(simulation, config, options.camera_pose(config.camera), self._friction)
            # The scene comes to rest before the arm is there, so an object never falls onto it.
            load_scene(simulation, scene, config, options.seed, self._friction)
            # Of the bare fingers.
            width = 0.0 if options.board else config.gripper.preshape_m + 2 * options.fingertip_offset_m
            load_machine(simulation, self._machine, min(max(width, rg2.MIN_WIDTH_M), rg2.MAX_WIDTH_M))
            if self._machine.visible:
                # The shoulder turns where the foot goes through a table that is higher than the arm's base.
                shoulder = simulation.joints[robot_model.ARM_JOINTS[0]]
                simulation.engine.setCollisionFilterPair(
                    table, simulation.robot, -1, shoulder, 0, physicsClientId=simulation.client
                )
            self._objects, self._quiet = scene.objects, [0] * len(scene.objects)
            surfaces = fixed_surfaces(config, options)
            if self._machine.visible:
                surfaces += robot_surfaces(simulation.joints, options)
            surfaces += object_surfaces(scene.objects)
            self._visuals = tuple(visual for visual, _ in surfaces)
            self._carriers = tuple(carrier for _, carrier in surfaces)
        except BaseException:
            self.close()
            raise

    def _let_sleep(self) -> None:
        """Put to sleep what has rested for a while; the engine itself would step it for two more seconds."""
        simulation = self.simulation
        for i, body in enumerate(simulation.bodies):
            self._quiet[i] = self._quiet[i] + 1 if is_at_rest(simulation, body) else 0
            # Again in every slice: of objects that touch, the engine lets all sleep or none.
            if self._quiet[i] >= QUIET_SLICES:
                put_to_sleep(simulation, body)


def _scene(config: CellConfig, options: TwinOptions) -> Scene:
    from sim_twin.scenes.catalog import make_scene

    return make_scene(
        options.scene, options.objects, options.seed, config.workspace, config.table.height_m, options.meshes
    )
