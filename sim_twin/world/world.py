"""The physics of the twin: one pybullet world that arm, gripper, camera and clock of a cell share.

Settings by experiment (240 Hz, 50 solver iterations, gear constraint, rolling friction, maximal coordinates and
sleeping for objects): docs/twin.md lists them with what they are good for.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from robotcell.errors import ConfigError, ConnectionLost
from robotcell.geometry import rg2
from robotcell.geometry.transforms import Array, cross, make_transform
from sim_twin.world import robot_model
from sim_twin.world.engine import load_pybullet
from sim_twin.world.furniture import furniture

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from robotcell.config import CellConfig
    from sim_twin.devices.backend import TwinOptions
    from sim_twin.scenes.catalog import Scene, SceneObject
    from sim_twin.scenes.shapes import Mesh, Shape

STEP_S = 1 / 240
GRAVITY_M_S2 = 9.81

_SOLVER_ITERATIONS = 50
# Solving ends early when a further iteration would change less than this; 30 objects then cost a tenth less.
_SOLVER_RESIDUAL = 1e-4
# Half the engine's default. It also widens the boxes by which the engine finds neighbours, and all objects whose boxes
# touch wake together: with the default the gripper wakes the whole table when it comes near one object.
_CONTACT_BREAKING_M = 0.01
_FINGER_FRICTION = 1.0
# Not only for what rolls: without it flat objects in a heap rock for ever and keep the whole heap awake.
_ROLLING_FRICTION = 0.001
_SPINNING_FRICTION = 0.002
# Rubber finger tips and the compliance of the arm behind them: a contact force grows over millimetres, as on the
# real cell, not within one step.
_TIP_STIFFNESS_N_M = 10000.0
_TIP_DAMPING_N_S_M = 20.0
# Moments of inertia of crank and finger: the motor's own, seen through the worm drive (assumed). The solver needs
# them of this size: with those of the bare links the gears give way to a grip of 40 N.
_CRANK_INERTIA_KG_M2 = 0.003
_FINGER_INERTIA_KG_M2 = 0.001
# The engine keeps this distance between convex shapes; they are made smaller by it.
_COLLISION_MARGIN_M = 0.001
_GEAR_ERP = 0.5
_GEAR_FORCE = 1000.0
# Below this speed [m/s and rad/s] for two seconds an object falls asleep. An object that rests on several pieces
# trembles at up to 0.4 rad/s for ever; a cylinder that rolls more slowly than this is as good as at rest.
_SLEEP_SPEED = 0.5

_DROP_STEPS = 72
_SETTLE_SLICE = 24
_SETTLE_SLICES = 100
_QUIET_SLICES = 3
_REST_SPEED = 0.01
_DROP_TRIES = 20
# The lowest point of a falling object starts this far above what lies below it.
_DROP_HEIGHT_M = 0.05

Kind = Literal["table", "bin", "post", "arm", "gripper", "board", "object"]


@dataclass(frozen=True)
class Visual:
    """A rigid surface as a camera sees it.

    Attributes:
        vertices: (N, 3) float32 [m], in its own frame.
        triangles: (M, 3) int32.
        color: (3,) uint8 RGB.
        kind: what it belongs to.
        object_index: place among `World.objects()`; -1 for everything else.
        texture: (h, w, 3) uint8 RGB, stretched over a rectangle in place of `color`; the four vertices are its corners:
            top left, top right, bottom right, bottom left.
    """

    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]
    color: npt.NDArray[np.uint8]
    kind: Kind
    object_index: int = -1
    texture: npt.NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Friction:
    """Coefficients of friction; the engine multiplies those of the two bodies that touch.

    Attributes:
        objects: of painted wood (assumed).
        table: of a laminate table top (assumed).
    """

    objects: float = 0.8
    table: float = 0.6


@dataclass(frozen=True)
class Contact:
    """Where the surroundings touched arm and gripper in the last step, base axes.

    Attributes:
        forces: (N, 3) on arm or gripper [N].
        places: (N, 3) [m].
        on_tool: (N,) whether it is the gripper that is touched.
    """

    forces: Array
    places: Array
    on_tool: npt.NDArray[np.bool_]

    @property
    def robot_force(self) -> Array:
        """(3,) sum of the forces on arm and gripper [N]."""
        return np.asarray(self.forces.sum(axis=0))

    def tool_wrench(self, point: Array) -> Array:
        """(6,) force on the gripper [N] and its torque about a point (3,) [N m]."""
        forces = self.forces[self.on_tool]
        torques = cross(self.places[self.on_tool] - point, forces)
        return np.concatenate([forces.sum(axis=0), torques.sum(axis=0)])


_NO_CONTACT = Contact(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_))


@dataclass
class _Built:
    """What exists while the engine runs."""

    engine: Any
    client: int
    robot: int = -1
    joints: dict[str, int] = field(default_factory=dict)
    bodies: list[int] = field(default_factory=list)
    # For how many slices in a row each body has been at rest.
    quiet: list[int] = field(default_factory=list)
    scene_objects: tuple[SceneObject, ...] = ()
    visuals: tuple[Visual, ...] = ()
    # The frame that carries each visual: ("fixed", 0), ("link", index), ("second crank", side), ("object", index).
    carriers: tuple[tuple[str, int], ...] = ()


class World:
    """One cell in the engine. It exists while at least one device is attached; each life starts from the scene."""

    def __init__(self, config: CellConfig, options: TwinOptions, friction: Friction | None = None) -> None:
        self.config = config
        self._options = options
        self._friction = friction or Friction()
        self._devices: list[object] = []
        self._controllers: list[Callable[[], None]] = []
        self._built: _Built | None = None
        self._steps = 0
        self._contact: tuple[int, Contact] = (-1, _NO_CONTACT)

    @property
    def time_s(self) -> float:
        """Simulated seconds since the world was made; stands still while nothing is attached."""
        return self._steps * STEP_S

    def attach(self, device: object) -> None:
        """Keep the world alive for a device; the first one builds it.

        Raises:
            ConfigError: the scene cannot be loaded, or does not come to rest in the workspace.
        """
        if self._built is None:
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
        built, self._built = self._built, None
        self._devices, self._controllers = [], []
        self._contact = (-1, _NO_CONTACT)
        if built is not None:
            built.engine.disconnect(physicsClientId=built.client)

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
        built = self._need()
        step, client = built.engine.stepSimulation, built.client
        for _ in range(n):
            for controller in self._controllers:
                controller()
            step(client)
            self._steps += 1
            if self._steps % _SETTLE_SLICE == 0:
                self._let_sleep()

    def joint_index(self, names: Sequence[str]) -> list[int]:
        """The engine's numbers of joints, see `robot_model`."""
        return [self._need().joints[name] for name in names]

    def joint_states(self, joints: Sequence[int]) -> tuple[Array, Array]:
        """Angles and speeds (N,) of joints [rad, rad/s]."""
        built = self._need()
        states = built.engine.getJointStates(built.robot, joints, physicsClientId=built.client)
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])

    def drive_positions(
        self, joints: Sequence[int], angles: Sequence[float], torques: Sequence[float], gains: Sequence[float]
    ) -> None:
        """Hold joints at angles [rad] with at most `torques` [N m]; `gains` is the error corrected per step, 0..1."""
        built = self._need()
        built.engine.setJointMotorControlArray(
            built.robot,
            joints,
            built.engine.POSITION_CONTROL,
            targetPositions=angles,
            forces=torques,
            positionGains=gains,
            physicsClientId=built.client,
        )

    def drive_speeds(self, joints: Sequence[int], speeds: Sequence[float], torques: Sequence[float]) -> None:
        """Turn joints at speeds [rad/s] with at most `torques` [N m]."""
        built = self._need()
        built.engine.setJointMotorControlArray(
            built.robot,
            joints,
            built.engine.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=torques,
            physicsClientId=built.client,
        )

    def flange(self) -> Array:
        """T_base_flange (4, 4)."""
        poses = self._link_poses([self._need().joints["flange"]])
        return np.asarray(poses[0])

    def contact(self) -> Contact:
        """What touched arm and gripper in the last step."""
        if self._contact[0] != self._steps:
            self._contact = (self._steps, self._measure_contact())
        return self._contact[1]

    def visuals(self) -> tuple[Visual, ...]:
        """Everything that a camera can see; constant while the world lives."""
        return self._need().visuals

    def visual_poses(self) -> Array:
        """T_base_visual (K, 4, 4) now, in the order of `visuals`."""
        built = self._need()
        joints = built.joints
        link_poses = self._link_poses(range(len(joints)))
        cranks, _ = self.joint_states([joints[robot_model.LEFT_CRANK], joints[robot_model.RIGHT_CRANK]])
        second = link_poses[joints["flange"]] @ robot_model.second_crank_frames(*cranks)
        groups = {
            "fixed": np.eye(4)[None],
            "link": link_poses,
            "second crank": second,
            "object": np.array([self._object_pose(body) for body in built.bodies]).reshape(-1, 4, 4),
        }
        return np.stack([groups[group][index] for group, index in built.carriers])

    def objects(self) -> list[tuple[SceneObject, Array]]:
        """Every object of the scene and its T_base_object (4, 4) now: for scoring only."""
        built = self._need()
        return [(o, self._object_pose(body)) for o, body in zip(built.scene_objects, built.bodies, strict=True)]

    def in_bin(self, index: int) -> bool:
        """Whether the centre of an object lies in the bin, below its rim."""
        x, y, z = self._object_pose(self._need().bodies[index])[:3, 3]
        (cx, cy), (sx, sy) = self.config.bin.center, self.config.bin.size
        rim = self.config.table.height_m + self.config.bin.wall_height_m
        return bool(abs(x - cx) < sx / 2 and abs(y - cy) < sy / 2 and z < rim)

    def _need(self) -> _Built:
        if self._built is None:
            raise ConnectionLost("the twin is not connected: open the cell, or connect the device, first")
        return self._built

    def _build(self) -> None:
        scene = self._make_scene()
        pybullet = load_pybullet()
        client = pybullet.connect(pybullet.DIRECT)
        if client < 0:
            raise ConnectionLost("the physics engine could not be started: too many worlds are open in this process")
        self._built = _Built(pybullet, client)
        try:
            pybullet.setGravity(0, 0, -GRAVITY_M_S2, physicsClientId=client)
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=STEP_S,
                numSolverIterations=_SOLVER_ITERATIONS,
                solverResidualThreshold=_SOLVER_RESIDUAL,
                contactBreakingThreshold=_CONTACT_BREAKING_M,
                deterministicOverlappingPairs=1,
                enableFileCaching=0,
                physicsClientId=client,
            )
            table = self._load_furniture()
            # The scene comes to rest before the arm is there, so an object never falls onto it.
            self._load_scene(scene)
            for body in self._built.bodies:
                if self._at_rest(body):
                    self._put_to_sleep(body)
            self._built.quiet = [0] * len(self._built.bodies)
            self._load_robot(table)
            self._make_visuals()
        except BaseException:
            self.close()
            raise

    def _make_scene(self) -> Scene:
        from sim_twin.scenes.catalog import make_scene

        config, options = self.config, self._options
        return make_scene(
            options.scene, options.objects, options.seed, config.workspace, config.table.height_m, options.meshes
        )

    def _load_furniture(self) -> int:
        built = self._need()
        p, client = built.engine, built.client
        bodies = []
        for _, part in furniture(self.config, self._options.camera_pose(self.config.camera)):
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[s / 2 for s in part.size], physicsClientId=client)
            T = part.T_link_part
            body = p.createMultiBody(0, shape, -1, T[:3, 3].tolist(), quaternion(T), physicsClientId=client)
            p.changeDynamics(body, -1, lateralFriction=self._friction.table, restitution=0, physicsClientId=client)
            bodies.append(body)
        return int(bodies[0])

    def _load_robot(self, table: int) -> None:
        arm = dict(zip(robot_model.ARM_JOINTS, self.config.motion.home_q, strict=True))
        built = self._load_machine(robot_model.urdf(), arm)
        # The shoulder turns where the foot goes through a table that is higher than the arm's base.
        shoulder = built.joints[robot_model.ARM_JOINTS[0]]
        built.engine.setCollisionFilterPair(table, built.robot, -1, shoulder, 0, physicsClientId=built.client)

    def _load_machine(self, urdf: str, start: dict[str, float]) -> _Built:
        """Load what carries the gripper, with its joints at `start`, and couple the fingers, pre-shaped."""
        built = self._need()
        p, client = built.engine, built.client
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "machine.urdf"
            path.write_text(urdf, encoding="utf-8")
            robot = built.robot = p.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        count = p.getNumJoints(robot, physicsClientId=client)
        built.joints = {p.getJointInfo(robot, i, physicsClientId=client)[1].decode(): i for i in range(count)}
        joints = built.joints
        for link in range(-1, count):
            p.changeDynamics(
                robot,
                link,
                linearDamping=0,
                angularDamping=0,
                jointDamping=0,
                restitution=0,
                lateralFriction=_FINGER_FRICTION,
                physicsClientId=client,
            )
        for finger in (robot_model.LEFT_FINGER, robot_model.RIGHT_FINGER):
            p.changeDynamics(
                robot,
                joints[finger],
                contactStiffness=_TIP_STIFFNESS_N_M,
                contactDamping=_TIP_DAMPING_N_S_M,
                localInertiaDiagonal=[_FINGER_INERTIA_KG_M2] * 3,
                physicsClientId=client,
            )
        for crank in (robot_model.LEFT_CRANK, robot_model.RIGHT_CRANK):
            inertia = [_CRANK_INERTIA_KG_M2] * 3
            p.changeDynamics(robot, joints[crank], localInertiaDiagonal=inertia, physicsClientId=client)
        angle = rg2.crank_angle(0.0 if self._options.board else self.config.gripper.preshape_m)
        for name, value in {**start, **robot_model.finger_angles(angle)}.items():
            p.resetJointState(robot, joints[name], value, physicsClientId=client)
            p.setJointMotorControl2(robot, joints[name], p.VELOCITY_CONTROL, force=0, physicsClientId=client)
        for a, b, ratio in (
            (robot_model.LEFT_CRANK, robot_model.RIGHT_CRANK, -1),
            (robot_model.LEFT_CRANK, robot_model.LEFT_FINGER, 1),
            (robot_model.RIGHT_CRANK, robot_model.RIGHT_FINGER, 1),
        ):
            gear = p.createConstraint(
                robot, joints[a], robot, joints[b], p.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0],
                physicsClientId=client,
            )  # fmt: skip
            p.changeConstraint(gear, gearRatio=ratio, erp=_GEAR_ERP, maxForce=_GEAR_FORCE, physicsClientId=client)
        return built

    def _load_scene(self, scene: Scene) -> None:
        built = self._need()
        p, client = built.engine, built.client
        built.scene_objects = scene.objects
        for item in scene.objects:
            body = self._create_object(item.shape, item.T_base_object)
            built.bodies.append(body)
            if scene.drop:
                self._let_fall(body)
                self._run(_DROP_STEPS)
        self._settle(scene)
        if not scene.drop:
            self._check_on_table(scene)
            return
        rng = np.random.default_rng([self._options.seed, 0xD50])
        for _ in range(_DROP_TRIES):
            lost = [body for body in built.bodies if not self._in_workspace(body)]
            if not lost:
                return
            for body in lost:
                x, y = (rng.uniform(0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b) for a, b in self._workspace_sides())
                # A normalised quaternion of normal numbers is a uniform rotation.
                turn = Rotation.from_quat(rng.normal(size=4)).as_quat()
                z = self.config.table.height_m + 0.15
                p.resetBasePositionAndOrientation(body, [x, y, z], turn.tolist(), physicsClientId=client)
                p.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=client)
                self._let_fall(body)
                self._run(_DROP_STEPS)
            self._settle(scene)
        raise ConfigError(
            f"scene {scene.name!r}: its objects keep rolling out of the workspace; use fewer objects or a larger one"
        )

    def _create_object(self, shape: Shape, T_base_object: Array) -> int:
        built = self._need()
        p, client = built.engine, built.client
        with tempfile.TemporaryDirectory() as folder:
            # Read twice: for the collision shape, and by the engine's own renderer when the body is made.
            path = Path(folder) / "parts.obj"
            path.write_text(_parts_as_obj(shape.parts), encoding="ascii")
            collision = p.createCollisionShape(p.GEOM_MESH, fileName=str(path), physicsClientId=client)
            body = p.createMultiBody(
                shape.density_kg_m3 * shape.volume_m3,
                collision,
                -1,
                T_base_object[:3, 3].tolist(),
                quaternion(T_base_object),
                useMaximalCoordinates=True,
                physicsClientId=client,
            )
        p.changeDynamics(
            body,
            -1,
            lateralFriction=self._friction.objects,
            rollingFriction=_ROLLING_FRICTION,
            spinningFriction=_SPINNING_FRICTION,
            restitution=0,
            sleepThreshold=_SLEEP_SPEED,
            activationState=p.ACTIVATION_STATE_ENABLE_SLEEPING,
            physicsClientId=client,
        )
        return int(body)

    def _let_fall(self, body: int) -> None:
        """Move a body that is about to fall to `_DROP_HEIGHT_M` above whatever is below it now."""
        built = self._need()
        p, client = built.engine, built.client
        low, high = p.getAABB(body, physicsClientId=client)
        floor = self.config.table.height_m
        for other in built.bodies:
            other_low, other_high = p.getAABB(other, physicsClientId=client)
            apart = any(low[i] > other_high[i] or other_low[i] > high[i] for i in (0, 1))
            if other != body and not apart:
                floor = max(floor, other_high[2])
        (x, y, z), turn = p.getBasePositionAndOrientation(body, physicsClientId=client)
        p.resetBasePositionAndOrientation(
            body, (x, y, z + floor + _DROP_HEIGHT_M - low[2]), turn, physicsClientId=client
        )
        p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_WAKE_UP, physicsClientId=client)

    def _run(self, steps: int) -> None:
        built = self._need()
        for _ in range(steps):
            built.engine.stepSimulation(built.client)

    def _settle(self, scene: Scene) -> None:
        """Wait until every object rests; the time before the devices are there does not count."""
        built = self._need()
        quiet = 0
        for _ in range(_SETTLE_SLICES):
            self._run(_SETTLE_SLICE)
            # What a drop scatters out of the workspace may roll on, or fall off the table; it is dropped again.
            resting = all(self._at_rest(body) or (scene.drop and not self._in_workspace(body)) for body in built.bodies)
            quiet = quiet + 1 if resting else 0
            if quiet == _QUIET_SLICES:
                return
            if not scene.drop:
                self._check_on_table(scene)
        raise ConfigError(f"scene {scene.name!r} does not come to rest: its objects overlap or keep rolling")

    def _check_on_table(self, scene: Scene) -> None:
        """Refuse a scene that puts objects where there is no table, or in it."""
        built = self._need()
        for item, body in zip(built.scene_objects, built.bodies, strict=True):
            x, y, z = self._object_pose(body)[:3, 3]
            if z < self.config.table.height_m:
                raise ConfigError(
                    f"scene {scene.name!r}: {item.name!r} fell off the table (x {x:.2f}, y {y:.2f} m): put it on the "
                    "table, in metres"
                )

    def _at_rest(self, body: int) -> bool:
        built = self._need()
        v, w = built.engine.getBaseVelocity(body, physicsClientId=built.client)
        return math.hypot(*v) < _REST_SPEED and math.hypot(*w) < _SLEEP_SPEED

    def _let_sleep(self) -> None:
        """Put to sleep what has rested for a while; the engine itself would step it for two more seconds."""
        built = self._need()
        for i, body in enumerate(built.bodies):
            built.quiet[i] = built.quiet[i] + 1 if self._at_rest(body) else 0
            # Again in every slice: of objects that touch, the engine lets all sleep or none.
            if built.quiet[i] >= _QUIET_SLICES:
                self._put_to_sleep(body)

    def _put_to_sleep(self, body: int) -> None:
        built = self._need()
        sleep = built.engine.ACTIVATION_STATE_SLEEP
        built.engine.changeDynamics(body, -1, activationState=sleep, physicsClientId=built.client)

    def _in_workspace(self, body: int) -> bool:
        x, y, z = self._object_pose(body)[:3, 3]
        (x0, x1), (y0, y1) = self._workspace_sides()
        return bool(x0 <= x <= x1 and y0 <= y <= y1 and z > self.config.table.height_m)

    def _workspace_sides(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return self.config.workspace.x, self.config.workspace.y

    def _object_pose(self, body: int) -> Array:
        built = self._need()
        position, turn = built.engine.getBasePositionAndOrientation(body, physicsClientId=built.client)
        return make_transform(Rotation.from_quat(turn).as_matrix(), position)

    def _link_poses(self, joints: Sequence[int]) -> Array:
        built = self._need()
        states = built.engine.getLinkStates(
            built.robot, list(joints), computeForwardKinematics=True, physicsClientId=built.client
        )
        T = np.tile(np.eye(4), (len(states), 1, 1))
        T[:, :3, :3] = Rotation.from_quat([s[5] for s in states]).as_matrix()
        T[:, :3, 3] = [s[4] for s in states]
        return T

    def _measure_contact(self) -> Contact:
        built = self._need()
        points = built.engine.getContactPoints(bodyA=built.robot, physicsClientId=built.client)
        if not points:
            return _NO_CONTACT
        # Normal force and two frictions of each contact, each a size and a direction that pushes the robot.
        sizes = np.array([(c[9], c[10], c[12]) for c in points])
        directions = np.array([(c[7], c[11], c[13]) for c in points])
        return Contact(
            forces=np.einsum("ni,nij->nj", sizes, directions),
            places=np.array([c[5] for c in points]),
            on_tool=np.array([c[3] >= built.joints["flange"] for c in points]),
        )

    def _make_visuals(self) -> None:
        built = self._need()
        entries: list[tuple[Visual, tuple[str, int]]] = []
        for kind, part in furniture(self.config, self._options.camera_pose(self.config.camera)):
            entries.append((_part_visual((part,), kind), ("fixed", 0)))
        if self._options.tag:
            from sim_twin.world.fixed_tag import tag_visual

            entries.append((tag_visual(self.config), ("fixed", 0)))
        entries += self._robot_visuals()
        for i, item in enumerate(built.scene_objects):
            mesh = item.shape.mesh
            color = np.array(item.color, dtype=np.uint8)
            visual = Visual(mesh.vertices.astype(np.float32), mesh.triangles, color, "object", i)
            entries.append((visual, ("object", i)))
        built.visuals = tuple(visual for visual, _ in entries)
        built.carriers = tuple(carrier for _, carrier in entries)

    def _robot_visuals(self) -> list[tuple[Visual, tuple[str, int]]]:
        """The arm and its gripper, each with the frame that carries it."""
        joints = self._need().joints
        entries: list[tuple[Visual, tuple[str, int]]] = []
        for group in _by_color(robot_model.base_parts()):
            entries.append((_part_visual(group, "arm"), ("fixed", 0)))
        for link in robot_model.links():
            index = joints[link.joint]
            body: Kind = "gripper" if index >= joints["flange"] else "arm"
            entries += [(_part_visual(group, body), ("link", index)) for group in _by_color(link.parts)]
        for side in (0, 1):
            entries.append((_part_visual(robot_model.second_crank_parts(), "gripper"), ("second crank", side)))
        if self._options.board:
            from sim_twin.world.held_board import board_visuals

            entries += [(visual, ("link", joints["flange"])) for visual in board_visuals(self._options.seed)]
        return entries


def quaternion(T: Array) -> list[float]:
    """(x, y, z, w) of the rotation of a transform (4, 4)."""
    return [float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat()]


def _by_color(parts: tuple[robot_model.Part, ...]) -> list[tuple[robot_model.Part, ...]]:
    colors = dict.fromkeys(part.color for part in parts)
    return [tuple(part for part in parts if part.color == color) for color in colors]


def _part_visual(parts: tuple[robot_model.Part, ...], kind: Kind) -> Visual:
    vertices, triangles, count = [], [], 0
    for part in parts:
        v, t = robot_model.part_mesh(part)
        vertices.append(v)
        triangles.append(t + count)
        count += len(v)
    color = np.array(parts[0].color, dtype=np.uint8)
    return Visual(np.vstack(vertices), np.vstack(triangles).astype(np.int32), color, kind)


def _parts_as_obj(parts: tuple[Mesh, ...]) -> str:
    """Convex parts as a Wavefront file: the engine makes one hull of each of its objects."""
    lines, count = [], 1
    for i, part in enumerate(parts):
        lines.append(f"o part{i}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in _shrunk(part.vertices).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (part.triangles + count).tolist()]
        count += len(part.vertices)
    return "\n".join(lines) + "\n"


def _shrunk(vertices: Array) -> Array:
    """Vertices moved towards their middle by the collision margin along each axis."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    return np.asarray(middle + (vertices - middle) * np.maximum(0.2, 1 - _COLLISION_MARGIN_M / np.maximum(half, 1e-9)))
