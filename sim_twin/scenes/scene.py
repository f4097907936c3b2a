"""What a scene is: objects with their poses, and whether they fall. Metres, base frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry.transforms import make_transform

if TYPE_CHECKING:
    from robotcell.config import Workspace
    from robotcell.geometry.transforms import Array
    from sim_twin.scenes.shapes import Shape


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


def place(scene: Scene, workspace: Workspace, table_height_m: float) -> Scene:
    """The scene with its origin in the centre of the workspace, on the table top."""
    origin = make_transform(np.eye(3), (sum(workspace.x) / 2, sum(workspace.y) / 2, table_height_m))
    objects = tuple(
        SceneObject(item.name, item.shape, item.color, origin @ item.T_base_object) for item in scene.objects
    )
    return Scene(scene.name, objects, scene.drop)
