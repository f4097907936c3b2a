"""Loads furniture, machines and objects into the engine, and says where they are."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from robotcell.geometry import rg2
from robotcell.geometry.transforms import Array, make_transform
from sim_twin.world import robot_model
from sim_twin.world.furniture import furniture

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CellConfig
    from sim_twin.scenes.meshes import Mesh
    from sim_twin.scenes.shapes import Shape
    from sim_twin.world.robot_model import Machine
    from sim_twin.world.simulation import Simulation

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
SLEEP_SPEED = 0.5
# An object that moves more slowly than this [m/s] and turns more slowly than `SLEEP_SPEED` is at rest.
_REST_SPEED = 0.01


@dataclass(frozen=True)
class Friction:
    """Coefficients of friction; the engine multiplies those of the two bodies that touch.

    Attributes:
        objects: of painted wood (assumed).
        table: of a laminate table top (assumed).
    """

    objects: float = 0.8
    table: float = 0.6


def load_furniture(simulation: Simulation, config: CellConfig, T_base_camera: Array, friction: Friction) -> int:
    """Load what stands still; the number of the table's body."""
    p, client = simulation.engine, simulation.client
    bodies = []
    for _, part in furniture(config, T_base_camera):
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[s / 2 for s in part.size], physicsClientId=client)
        T = part.T_link_part
        body = p.createMultiBody(0, shape, -1, T[:3, 3].tolist(), quaternion(T), physicsClientId=client)
        p.changeDynamics(body, -1, lateralFriction=friction.table, restitution=0, physicsClientId=client)
        bodies.append(body)
    return int(bodies[0])


def load_machine(simulation: Simulation, machine: Machine, width_m: float) -> None:
    """Load what carries the gripper, with its joints at their start, and couple the fingers, so far open."""
    p, client = simulation.engine, simulation.client
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.urdf"
        path.write_text(machine.urdf, encoding="utf-8")
        robot = simulation.robot = p.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
    count = p.getNumJoints(robot, physicsClientId=client)
    simulation.joints = {p.getJointInfo(robot, i, physicsClientId=client)[1].decode(): i for i in range(count)}
    joints = simulation.joints
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
    angle = rg2.crank_angle(width_m)
    for name, value in {**machine.start, **robot_model.finger_angles(angle)}.items():
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


def load_object(simulation: Simulation, shape: Shape, T_base_object: Array, friction: Friction) -> int:
    """Load an object; the number of its body."""
    p, client = simulation.engine, simulation.client
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
        lateralFriction=friction.objects,
        rollingFriction=_ROLLING_FRICTION,
        spinningFriction=_SPINNING_FRICTION,
        restitution=0,
        sleepThreshold=SLEEP_SPEED,
        activationState=p.ACTIVATION_STATE_ENABLE_SLEEPING,
        physicsClientId=client,
    )
    return int(body)


def object_pose(simulation: Simulation, body: int) -> Array:
    """T_base_object (4, 4)."""
    position, turn = simulation.engine.getBasePositionAndOrientation(body, physicsClientId=simulation.client)
    return make_transform(Rotation.from_quat(turn).as_matrix(), position)


def link_poses(simulation: Simulation, joints: Sequence[int]) -> Array:
    """T_base_link (N, 4, 4) of the links that joints carry."""
    states = simulation.engine.getLinkStates(
        simulation.robot, list(joints), computeForwardKinematics=True, physicsClientId=simulation.client
    )
    T = np.tile(np.eye(4), (len(states), 1, 1))
    T[:, :3, :3] = Rotation.from_quat([s[5] for s in states]).as_matrix()
    T[:, :3, 3] = [s[4] for s in states]
    return T


def is_at_rest(simulation: Simulation, body: int) -> bool:
    """Whether an object neither moves nor turns."""
    v, w = simulation.engine.getBaseVelocity(body, physicsClientId=simulation.client)
    return math.hypot(*v) < _REST_SPEED and math.hypot(*w) < SLEEP_SPEED


def put_to_sleep(simulation: Simulation, body: int) -> None:
    """Let the engine step an object no longer until something touches it."""
    sleep = simulation.engine.ACTIVATION_STATE_SLEEP
    simulation.engine.changeDynamics(body, -1, activationState=sleep, physicsClientId=simulation.client)


def wake(simulation: Simulation, body: int) -> None:
    """Let the engine step an object again."""
    awake = simulation.engine.ACTIVATION_STATE_WAKE_UP
    simulation.engine.changeDynamics(body, -1, activationState=awake, physicsClientId=simulation.client)


def put_body(simulation: Simulation, body: int, position: Sequence[float], quaternion_xyzw: Sequence[float]) -> None:
    """Put an object somewhere at once, at rest."""
    p, client = simulation.engine, simulation.client
    p.resetBasePositionAndOrientation(body, position, quaternion_xyzw, physicsClientId=client)
    p.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=client)


def quaternion(T: Array) -> list[float]:
    """(x, y, z, w) of the rotation of a transform (4, 4)."""
    return [float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat()]


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
