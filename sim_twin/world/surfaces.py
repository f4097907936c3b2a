"""What of a world a camera can see, and the frame that carries each surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from sim_twin.visual import Kind, Visual
from sim_twin.world import robot_model
from sim_twin.world.bodies import link_poses, object_pose
from sim_twin.world.furniture import furniture

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from sim_twin.options import TwinOptions
    from sim_twin.scenes.scene import SceneObject
    from sim_twin.world.simulation import Simulation

# The frame that carries a surface, and its number: of a link, of a side of the gripper, or of an object.
Carrier = tuple[Literal["fixed", "link", "second crank", "object"], int]
Surface = tuple[Visual, Carrier]


def fixed_surfaces(config: CellConfig, options: TwinOptions) -> list[Surface]:
    """The furniture, and the tag on the table where there is one."""
    found: list[Surface] = []
    for kind, part in furniture(config, options.camera_pose(config.camera)):
        found.append((_part_visual((part,), kind), ("fixed", 0)))
    if options.tag:
        from sim_twin.world.fixed_tag import tag_visual

        found.append((tag_visual(config), ("fixed", 0)))
    return found


def robot_surfaces(joints: dict[str, int], options: TwinOptions) -> list[Surface]:
    """The arm and its gripper, and the board in its fingers where there is one."""
    found: list[Surface] = []
    for group in _by_color(robot_model.base_parts()):
        found.append((_part_visual(group, "arm"), ("fixed", 0)))
    for link in robot_model.links(options.fingertip_offset_m):
        index = joints[link.joint]
        body: Kind = "gripper" if index >= joints["flange"] else "arm"
        found += [(_part_visual(group, body), ("link", index)) for group in _by_color(link.parts)]
    for side in (0, 1):
        found.append((_part_visual(robot_model.second_crank_parts(), "gripper"), ("second crank", side)))
    if options.board:
        from sim_twin.world.held_board import board_visuals

        found += [(visual, ("link", joints["flange"])) for visual in board_visuals(options.seed)]
    return found


def object_surfaces(objects: Sequence[SceneObject]) -> list[Surface]:
    """The objects of a scene."""
    found: list[Surface] = []
    for i, item in enumerate(objects):
        mesh, color = item.shape.mesh, np.array(item.color, dtype=np.uint8)
        found.append((Visual(mesh.vertices.astype(np.float32), mesh.triangles, color, "object", i), ("object", i)))
    return found


def carrier_poses(simulation: Simulation, carriers: Sequence[Carrier]) -> Array:
    """T_base_carrier (K, 4, 4) now."""
    joints = simulation.joints
    poses = link_poses(simulation, range(len(joints)))
    cranks = [joints[robot_model.LEFT_CRANK], joints[robot_model.RIGHT_CRANK]]
    states = simulation.engine.getJointStates(simulation.robot, cranks, physicsClientId=simulation.client)
    second = poses[joints["flange"]] @ robot_model.second_crank_frames(states[0][0], states[1][0])
    objects = [object_pose(simulation, body) for body in simulation.bodies]
    groups = {
        "fixed": np.eye(4)[None],
        "link": poses,
        "second crank": second,
        "object": np.array(objects).reshape(-1, 4, 4),
    }
    return np.stack([groups[group][index] for group, index in carriers])


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
