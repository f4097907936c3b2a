"""Closed triangle meshes and their mass properties. Metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

# The formats of files that meshes are read from, see `mesh_files`.
MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".dae")


@dataclass(frozen=True)
class Mesh:
    """A closed triangle mesh, outward normals by the right-hand rule.

    Attributes:
        vertices: (N, 3) float64 [m].
        triangles: (M, 3) int32, rows of `vertices`.
    """

    vertices: Array
    triangles: npt.NDArray[np.int32]


def join(meshes: tuple[Mesh, ...]) -> Mesh:
    """One mesh of several."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.triangles + n for m, n in zip(meshes, offsets, strict=True)]).astype(np.int32),
    )


def bounds_center(mesh: Mesh) -> Array:
    """Centre (3,) [m] of the bounding box along the mesh's axes."""
    return np.asarray((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2)


def mesh_volume(mesh: Mesh) -> float:
    """Volume [m3] of a closed mesh; negative when its normals point inwards."""
    return float(_signed_tetrahedra(mesh).sum())


def mesh_centroid(mesh: Mesh) -> Array:
    """Volume centroid (3,) [m] of a closed mesh."""
    volumes = _signed_tetrahedra(mesh)
    # The fourth corner of each tetrahedron is the origin.
    return np.asarray(volumes @ mesh.vertices[mesh.triangles].sum(axis=1) / (4 * volumes.sum()))


def mesh_inertia(mesh: Mesh) -> Array:
    """Inertia tensor (3, 3) [m5] of a closed mesh of density 1 about its volume centroid."""
    from trimesh.triangles import mass_properties

    # Near the origin, where the sums lose no digits.
    return np.asarray(mass_properties((mesh.vertices - mesh_centroid(mesh))[mesh.triangles]).inertia)


def hull(points: Array) -> Mesh:
    """The convex hull of (N, 3) points [m]; its vertices keep their order.

    Raises:
        ValueError: the points lie in a plane.
    """
    try:
        result = ConvexHull(points)
    except QhullError as error:
        raise ValueError("the points lie in a plane and enclose no volume") from error
    used = np.unique(result.simplices)
    vertices = np.asarray(points, dtype=np.float64)[used]
    triangles = np.searchsorted(used, result.simplices)
    corners = vertices[triangles]
    # Qhull gives each triangle's outward normal, and its corners in either order.
    inward = np.einsum(
        "mi,mi->m",
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        result.equations[:, :3],
    )
    triangles[inward < 0] = triangles[inward < 0][:, ::-1]
    return Mesh(vertices, triangles.astype(np.int32))


def _signed_tetrahedra(mesh: Mesh) -> Array:
    corners = mesh.vertices[mesh.triangles]
    volumes: Array = np.einsum("mi,mi->m", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return volumes
