"""What stands on the twin's table when a job begins.

Scenes are made in a frame of their own (x and y from the centre of the workspace, z from the table top) and
placed into the workspace that is configured. Metres, radians, base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from robotcell.errors import ConfigError
from robotcell.geometry import make_transform
from robotcell.palette import PALETTE
from sim_twin.shapes import BLOCK_NAMES, block

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from robotcell.config import Workspace
    from robotcell.geometry import Array
    from sim_twin.shapes import Shape

# Drops scatter over a square of this half width about the centre: half of the papers' 448 mm workspace.
DROP_HALF_WIDTH_M = 0.112
# The lowest point of an object that is dropped onto the bare table.
_DROP_HEIGHT_M = 0.06
_DROP_GAP_M = 0.005
_DROP_CANDIDATES = 8


@dataclass(frozen=True)
class SceneObject:
    """An object of a scene.

    Attributes:
        name: unique in its scene.
        shape: what it is.
        color: RGB, 0..255.
        T_base_object: pose of the shape's frame.
    """

    name: str
    shape: Shape
    color: tuple[int, int, int]
    T_base_object: Array


@dataclass(frozen=True)
class Scene:
    """A scene.

    Attributes:
        name: as it was asked for.
        objects: in the order in which they are let go.
        drop: whether the objects fall from where they are given; otherwise they stand there already.
    """

    name: str
    objects: tuple[SceneObject, ...]
    drop: bool


def make_scene(
    name: str, count: int, seed: int, workspace: Workspace, table_height_m: float, meshes: Path | None
) -> Scene:
    """Make the scene of that name.

    Args:
        name: `random`.
        count: number of objects, where the scene leaves it open.
        seed: of the draw.
        workspace: where the scene is put.
        table_height_m: z of the table top.
        meshes: folder with the OBJ files that a scene file names.

    Raises:
        ConfigError: there is no such scene; the message lists what there is.
    """
    if count < 1:
        raise ConfigError(f"a scene needs at least one object; {count} were asked for")
    if name == "random":
        rng = np.random.default_rng(seed)
        shapes = [block(BLOCK_NAMES[i]) for i in rng.integers(len(BLOCK_NAMES), size=count)]
        scene = drop_scene(name, shapes, rng)
    else:
        raise ConfigError(f"no scene is called {name!r}; there are random")
    return place(scene, workspace, table_height_m)


def drop_scene(name: str, shapes: Sequence[Shape], rng: np.random.Generator) -> Scene:
    """Let the shapes fall, in random colours and orientations, above a square about the scene's origin.

    Each object starts as low as the ones before it leave room, so that nothing starts inside another, whether
    they are let go one after the other or all at once.
    """
    centres = np.zeros((0, 3))
    radii = np.zeros(0)
    objects = []
    for i, (shape, color) in enumerate(zip(shapes, _colors(len(shapes), rng), strict=True)):
        radius = float(np.linalg.norm(shape.mesh.vertices, axis=1).max())
        spots = rng.uniform(-DROP_HALF_WIDTH_M, DROP_HALF_WIDTH_M, size=(_DROP_CANDIDATES, 2))
        heights = [_free_height(spot, radius, centres, radii) for spot in spots]
        lowest = int(np.argmin(heights))
        centre = np.array([*spots[lowest], heights[lowest]])
        centres, radii = np.vstack([centres, centre]), np.append(radii, radius)
        T = make_transform(_random_rotation(rng), centre)
        objects.append(SceneObject(f"{color} {shape.name} {i + 1}", shape, PALETTE[color], T))
    return Scene(name, tuple(objects), drop=True)


def place(scene: Scene, workspace: Workspace, table_height_m: float) -> Scene:
    """The scene with its origin in the centre of the workspace, on the table top."""
    origin = make_transform(np.eye(3), (sum(workspace.x) / 2, sum(workspace.y) / 2, table_height_m))
    objects = tuple(
        SceneObject(item.name, item.shape, item.color, origin @ item.T_base_object) for item in scene.objects
    )
    return Scene(scene.name, objects, scene.drop)


def _colors(count: int, rng: np.random.Generator) -> list[str]:
    """Names of colours: shuffled decks of the ten, so that ten objects show each of them once."""
    names = list(PALETTE)
    decks = [rng.permutation(len(names)) for _ in range(-(-count // len(names)))]
    return [names[i] for i in np.concatenate(decks)[:count]]


def _random_rotation(rng: np.random.Generator) -> Array:
    # A normalised Gaussian four-vector is uniform over the unit quaternions.
    return np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix())


def _free_height(spot: Array, radius: float, centres: Array, radii: Array) -> float:
    """The lowest z [m] of a sphere above `spot` (2,) that lies over all the spheres it would touch."""
    reach = radii + radius + _DROP_GAP_M
    lateral = np.linalg.norm(centres[:, :2] - spot, axis=1)
    near = lateral < reach
    above = centres[near, 2] + np.sqrt(reach[near] ** 2 - lateral[near] ** 2)
    return float(max([radius + _DROP_HEIGHT_M, *above]))
