"""What stands on the twin's table when a job begins: random drops, built-in arrangements, novel objects, files.

Scenes are made in a frame of their own (x and y from the centre of the workspace, z from the table top) and
placed into the workspace that is configured. Metres, radians.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from robotcell.errors import ConfigError
from robotcell.geometry.transforms import make_transform
from robotcell.perception.colors import PALETTE
from sim_twin.scenes.files import read_scene
from sim_twin.scenes.novel import novel_shapes
from sim_twin.scenes.scene import Scene, SceneObject, place
from sim_twin.scenes.shapes import BLOCK_NAMES, block

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import Workspace
    from robotcell.geometry.transforms import Array
    from sim_twin.scenes.shapes import Shape

__all__ = ["Scene", "SceneObject", "make_scene", "scene_names"]

# The one object of this colour is what `random-goal` and the built-in arrangements are about.
GOAL = "red"
# Drops scatter over a square of this half width about the centre: half of the papers' 448 mm workspace.
DROP_HALF_WIDTH_M = 0.112
# The lowest point of an object that is dropped onto the bare table.
_DROP_HEIGHT_M = 0.06
_DROP_GAP_M = 0.005
_DROP_CANDIDATES = 8
_BUILT_IN = Path(__file__).parent


def scene_names() -> list[str]:
    """The names that `make_scene` knows without a file."""
    return ["random", "random-goal", "novel", *sorted(path.stem for path in _BUILT_IN.glob("*.toml"))]


def make_scene(
    name: str, count: int, seed: int, workspace: Workspace, table_height_m: float, meshes: Path | None
) -> Scene:
    """Make the scene of that name.

    Args:
        name: one of `scene_names()`, or the path of a scene file (see docs/reference/scene-files.md).
        count: number of objects of `random`, `random-goal` and `novel`; the other scenes have their own.
        seed: of what those three draw.
        workspace: where the scene is put.
        table_height_m: z of the table top.
        meshes: folder with the mesh files that a scene file names.

    Raises:
        ConfigError: there is no such scene (the message lists what there is), or its file is malformed.
    """
    if count < 1:
        raise ConfigError(f"a scene needs at least one object; {count} were asked for")
    if meshes is not None and name in scene_names():
        raise ConfigError(f"scene {name!r} has its own meshes; --meshes {meshes} belongs to a scene file")
    rng = np.random.default_rng(seed)
    if name in {"random", "random-goal"}:
        shapes = [block(BLOCK_NAMES[i]) for i in rng.integers(len(BLOCK_NAMES), size=count)]
        scene = drop_scene(name, shapes, rng, GOAL if name == "random-goal" else None)
    elif name == "novel":
        scene = drop_scene(name, novel_shapes(count, rng), rng)
    elif name in scene_names():
        scene = read_scene(_BUILT_IN / f"{name}.toml", None)
    elif _is_file(Path(name)):
        scene = read_scene(Path(name), meshes)
    else:
        raise ConfigError(
            f"no scene or scene file is called {name[:80]!r}; there are {', '.join(scene_names())}, "
            "or the path of a file"
        )
    return place(scene, workspace, table_height_m)


def drop_scene(name: str, shapes: Sequence[Shape], rng: np.random.Generator, goal: str | None = None) -> Scene:
    """Let the shapes fall, in random colours and orientations, above a square about the scene's origin.

    Each object starts as low as the ones before it leave room, so that nothing starts inside another, whether
    they are let go one after the other or all at once. With a goal exactly one of them, any, has that colour.
    """
    centres: Array = np.zeros((0, 3))
    radii: Array = np.zeros(0)
    objects = []
    for i, (shape, color) in enumerate(zip(shapes, _colors(len(shapes), rng, goal), strict=True)):
        radius = float(np.linalg.norm(shape.mesh.vertices, axis=1).max())
        spots = rng.uniform(-DROP_HALF_WIDTH_M, DROP_HALF_WIDTH_M, size=(_DROP_CANDIDATES, 2))
        heights = [_free_height(spot, radius, centres, radii) for spot in spots]
        lowest = int(np.argmin(heights))
        centre = np.array([*spots[lowest], heights[lowest]])
        centres, radii = np.vstack([centres, centre]), np.append(radii, radius)
        T = make_transform(_random_rotation(rng), centre)
        objects.append(SceneObject(f"{color} {shape.name} {i + 1}", shape, PALETTE[color], T))
    return Scene(name, tuple(objects), drop=True)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # of a name that no file can have
        return False


def _colors(count: int, rng: np.random.Generator, goal: str | None) -> list[str]:
    """Names of colours: shuffled decks of the ten, so that ten objects show each of them once.

    With a goal decks of the other nine, and that colour for one object.
    """
    names = [name for name in PALETTE if name != goal]
    others = count if goal is None else count - 1
    decks = [rng.permutation(len(names)) for _ in range(-(-others // len(names)))]
    colors = [names[i] for deck in decks for i in deck][:others]
    if goal is not None:
        colors.insert(rng.integers(count), goal)
    return colors


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
