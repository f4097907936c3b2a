"""Novel objects: the random solids that pybullet_data carries, those of them that the gripper can grasp.

Objects 000 to 899 are used. 900 to 999 are kept for evaluations that no design decision has seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from robotcell.errors import ConfigError
from sim_twin.scenes.meshes import Mesh, hull, mesh_volume
from sim_twin.scenes.shapes import shape_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.geometry.transforms import Array
    from sim_twin.scenes.shapes import Shape

NOVEL_COUNT = 900
# The RG2's 110 mm stroke less a finger's room on each side; the cell pre-shapes to 80 mm.
MAX_GRASP_WIDTH_M = 0.080
# Fingers that stay clear of the table need something to press on.
MIN_HEIGHT_M = 0.015

# The scale of all their URDF files.
_SCALE = 0.015
# Triangles this close to parallel are one face; corners this close to its plane belong to it.
_SAME_FACE_COSINE = 0.999
_FACE_THICKNESS_M = 0.0005
# A face that the centre of mass is this far inside of is not tipped over by a touch.
_STABLE_MARGIN_M = 0.001
# Pieces closer than this hold together.
_GAP_M = 0.0005
# Ten of the files hold slivers, 1 mm thick on average, that cover an object and leave it empty: 5 to 11 % of its hull,
# all others 36 % and more. Fingers sink through walls that weigh two grams.
_LEAST_FILLED = 0.2


@dataclass(frozen=True)
class RestingPose:
    """How a solid lies on a table.

    Attributes:
        down: (3,) unit vector that points to the table, in the shape's frame.
        height_m: of the solid above the table.
        width_m: the smallest distance of two vertical planes that hold the solid between them.
    """

    down: Array
    height_m: float
    width_m: float


def novel_shapes(count: int, rng: np.random.Generator) -> list[Shape]:
    """Draw different graspable objects.

    Raises:
        ConfigError: there are not so many, or pybullet_data is not installed.
    """
    _folder()
    shapes: list[Shape] = []
    for number in rng.permutation(NOVEL_COUNT):
        if len(shapes) == count:
            break
        if is_graspable(int(number)):
            shapes.append(novel_shape(int(number)))
    if len(shapes) < count:
        raise ConfigError(f"there are {len(shapes)} graspable novel objects; {count} were asked for")
    return shapes


@cache
def novel_shape(number: int) -> Shape:
    """The object of that number, 0 to 899; its parts are the convex pieces that its file consists of.

    Raises:
        ConfigError: the number is outside the range, or pybullet_data is not installed.
    """
    if not 0 <= number < NOVEL_COUNT:
        raise ConfigError(f"novel object {number} is outside 0 to {NOVEL_COUNT - 1}")
    from sim_twin.scenes.mesh_files import load_meshes

    path = _folder() / f"{number:03d}" / f"{number:03d}.obj"
    return shape_of(f"novel_{number:03d}", tuple(Mesh(_SCALE * m.vertices, m.triangles) for m in load_meshes(path)))


@cache
def is_graspable(number: int) -> bool:
    """Whether the object is one solid that fits between the fingers, and is not too flat, however it comes to rest.

    Pieces that leave it nearly empty are no solid.
    """
    try:
        shape = novel_shape(number)
    except ConfigError:
        return False  # one of the files holds NaN
    fits = all(pose.width_m <= MAX_GRASP_WIDTH_M and pose.height_m >= MIN_HEIGHT_M for pose in resting_poses(shape))
    filled = shape.volume_m3 > _LEAST_FILLED * mesh_volume(hull(shape.mesh.vertices))
    return fits and filled and _is_connected(shape.parts)


def resting_poses(shape: Shape) -> Iterator[RestingPose]:
    """The ways in which a shape lies still: faces of its hull that have the centre of mass above them.

    The largest faces come first.
    """
    solid = hull(shape.mesh.vertices)
    corners = solid.vertices[solid.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    seen = np.zeros((0, 3))
    for i in np.argsort(-areas):
        down = normals[i] / areas[i]
        if (seen @ down > _SAME_FACE_COSINE).any():
            continue
        seen = np.vstack([seen, down])
        depth = solid.vertices @ down
        # Two axes in the table's plane; the centre of mass is the origin.
        flat = solid.vertices @ np.linalg.svd(down[None])[2][1:].T
        if _margin(flat[depth > depth.max() - _FACE_THICKNESS_M]) > _STABLE_MARGIN_M:
            yield RestingPose(down, float(np.ptp(depth)), _smallest_width(flat))


def _is_connected(parts: tuple[Mesh, ...]) -> bool:
    """Whether convex parts hold together; some files have pieces that float beside the rest."""
    planes = [ConvexHull(part.vertices).equations for part in parts]

    def apart(i: int, j: int) -> bool:
        # The bodies have a face of one of them between them, as pieces of one cut solid do.
        outside = parts[j].vertices @ planes[i][:, :3].T + planes[i][:, 3]
        return bool(outside.min(axis=0).max() > _GAP_M)

    reached, waiting = [0], set(range(1, len(parts)))
    while reached:
        piece = reached.pop()
        touching = {i for i in waiting if not (apart(i, piece) or apart(piece, i))}
        waiting -= touching
        reached += touching
    return not waiting


def _margin(face: Array) -> float:
    """How far [m] the origin is inside the convex hull of (N, 2) points; negative outside."""
    try:
        return -float(ConvexHull(face).equations[:, 2].max())
    except (QhullError, ValueError):
        return -math.inf  # fewer than three points, or all on a line


def _smallest_width(points: Array) -> float:
    """The smallest distance [m] of two parallel lines that hold (N, 2) points; one lies along an edge of their hull."""
    outline = ConvexHull(points)
    extents = np.ptp(points @ outline.equations[:, :2].T, axis=0)
    return float(extents.min())


def _folder() -> Path:
    try:
        import pybullet_data
    except ImportError:
        raise ConfigError("novel objects come with pybullet: pip install 'robotcell[twin]'") from None
    return Path(pybullet_data.getDataPath()) / "random_urdfs"
