"""Closed triangle meshes: volume, inertia, hulls, convex pieces, and reading them from OBJ files. Metres."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.geometry import Array

# A mesh whose hull is larger than itself by more than this share collides in pieces.
CONCAVITY_TOLERANCE = 0.02

_MAX_PARTS = 24
_CUTS_PER_AXIS = 9
# Share of a surface that may be missing.
_MAX_GAP = 0.005


@dataclass(frozen=True)
class Mesh:
    """A closed triangle mesh, outward normals by the right-hand rule.

    Attributes:
        vertices: (N, 3) float64 [m].
        triangles: (M, 3) int32, rows of `vertices`.
    """

    vertices: Array
    triangles: npt.NDArray[np.int32]


def load_obj(path: Path) -> tuple[Mesh, ...]:
    """The objects of a Wavefront OBJ file, as closed meshes with outward normals.

    Vertices and faces are read (polygons as fans, `v/vt/vn` and negative indices included), the rest is not.
    Objects that are closed only together come as one mesh.

    Raises:
        ConfigError: the file is missing or malformed, with the line, or a mesh in it is not closed.
    """
    vertices: list[tuple[float, ...]] = []
    objects: list[list[tuple[int, int, int]]] = [[]]
    for number, line in enumerate(_lines(path), start=1):
        keyword, *fields = line.split("#", 1)[0].split() or [""]
        try:
            if keyword == "v":
                vertices.append(_vertex(fields))
            elif keyword == "f":
                objects[-1] += _fan([_index(field, len(vertices)) for field in fields])
            elif keyword == "o":
                objects.append([])
        except ValueError as error:
            raise ConfigError(f"{path}, line {number}: {error}: {line.strip()!r}") from None
    meshes = tuple(_compact(vertices, triangles) for triangles in objects if triangles)
    if not meshes:
        raise ConfigError(f"{path}: holds no faces; a closed mesh is needed")
    if not all(_is_closed(mesh) for mesh in meshes):
        meshes = (join(meshes),)
    if not all(_is_closed(mesh) for mesh in meshes):
        raise ConfigError(f"{path}: the surface is flat or not closed; a closed mesh is needed")
    return tuple(_outward(mesh) for mesh in meshes)


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
    """Inertia tensor (3, 3) [m5] of a closed mesh of density 1 about its volume centroid.

    A tetrahedron with one corner at the origin has the second moments V/20 (sum_i p_i p_i^T + s s^T) with
    s = sum_i p_i.
    """
    centred = Mesh(mesh.vertices - mesh_centroid(mesh), mesh.triangles)
    corners = centred.vertices[centred.triangles]
    sums = corners.sum(axis=1)
    volumes = _signed_tetrahedra(centred)
    moments = np.einsum("m,mci,mcj->ij", volumes, corners, corners) + np.einsum("m,mi,mj->ij", volumes, sums, sums)
    moments /= 20
    return np.asarray(np.trace(moments) * np.eye(3) - moments)


def hull(points: Array) -> Mesh:
    """The convex hull of (N, 3) points [m].

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
    inward = np.einsum(
        "mi,mi->m",
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        result.equations[:, :3],
    )
    triangles[inward < 0] = triangles[inward < 0][:, ::-1]
    return Mesh(vertices, triangles.astype(np.int32))


def convex_parts(mesh: Mesh) -> tuple[Mesh, ...]:
    """Convex pieces that together fill a closed mesh: its hull, where that hardly differs from it.

    A concave mesh is cut along planes across its axes, each time where the hulls of the pieces lose most
    volume, until together they exceed the mesh by at most `CONCAVITY_TOLERANCE` or no cut helps.

    Raises:
        ValueError: the mesh is flat.
    """
    limit = (1 + CONCAVITY_TOLERANCE) * mesh_volume(mesh)
    whole = hull(mesh.vertices)
    if mesh_volume(whole) <= limit:
        return (whole,)
    pieces = [_piece(list(mesh.vertices[mesh.triangles]))]
    while sum(piece.volume for piece in pieces) > limit and len(pieces) < _MAX_PARTS:
        worst = max(pieces, key=lambda piece: piece.cut_gain)
        if worst.cut_gain <= 0:
            break
        pieces.remove(worst)
        pieces += [_piece(_clip(worst.polygons, worst.cut_axis, worst.cut_at, side)) for side in (-1.0, 1.0)]
    return tuple(hull(np.concatenate(piece.polygons)) for piece in pieces)


@dataclass(frozen=True, eq=False)
class _Piece:
    """The surface of a mesh between cutting planes, its hull's volume, and the cut that saves most of it."""

    polygons: list[Array]
    volume: float
    cut_axis: int
    cut_at: float
    cut_gain: float


def _piece(polygons: list[Array]) -> _Piece:
    starts = np.concatenate(polygons)
    ends = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in polygons])
    volume = _hull_volume(starts)
    cuts = []
    for axis in range(3):
        low, high = starts[:, axis].min(), starts[:, axis].max()
        for at in np.linspace(low, high, _CUTS_PER_AXIS + 2)[1:-1]:
            crossing = (starts[:, axis] - at) * (ends[:, axis] - at) < 0
            a, b = starts[crossing], ends[crossing]
            section = a + ((at - a[:, axis]) / (b[:, axis] - a[:, axis]))[:, None] * (b - a)
            halves = (starts[side * (starts[:, axis] - at) >= 0] for side in (-1, 1))
            remaining = sum(_hull_volume(np.concatenate([half, section])) for half in halves)
            cuts.append((volume - remaining, axis, float(at)))
    gain, axis, at = max(cuts)
    return _Piece(polygons, volume, axis, at, gain)


def _clip(polygons: list[Array], axis: int, at: float, side: float) -> list[Array]:
    """The parts of convex polygons on one side of a plane (Sutherland-Hodgman)."""
    kept = []
    for polygon in polygons:
        distance = side * (polygon[:, axis] - at)
        points = []
        for i, (d, d_next) in enumerate(zip(distance, np.roll(distance, -1), strict=True)):
            if d >= 0:
                points.append(polygon[i])
            if d * d_next < 0:
                points.append(polygon[i] + d / (d - d_next) * (polygon[(i + 1) % len(polygon)] - polygon[i]))
        if len(points) >= 3:
            kept.append(np.array(points))
    return kept


def _hull_volume(points: Array) -> float:
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0


def _signed_tetrahedra(mesh: Mesh) -> Array:
    corners = mesh.vertices[mesh.triangles]
    volumes: Array = np.einsum("mi,mi->m", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return volumes


def _is_closed(mesh: Mesh) -> bool:
    # The area vectors of a closed surface add up to nothing. Edges are not counted: small cracks, where faces meet
    # in edges that differ, do no harm.
    corners = mesh.vertices[mesh.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    gap = np.linalg.norm(areas.sum(axis=0)) / max(np.linalg.norm(areas, axis=1).sum(), 1e-30)
    limit = _hull_volume(mesh.vertices)
    return bool(gap < _MAX_GAP and 0.01 * limit < abs(mesh_volume(mesh)) < 1.001 * limit)


def _outward(mesh: Mesh) -> Mesh:
    return mesh if mesh_volume(mesh) > 0 else Mesh(mesh.vertices, mesh.triangles[:, ::-1])


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such mesh file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text: {error}") from error


def _vertex(fields: list[str]) -> tuple[float, ...]:
    numbers = tuple(float(field) for field in fields[:3])
    if len(numbers) < 3:
        raise ValueError("a vertex needs three numbers")
    if not np.isfinite(numbers).all():
        raise ValueError("a vertex needs finite numbers")
    return numbers


def _index(field: str, count: int) -> int:
    """Row of the vertex that a face names; OBJ counts from 1, or back from the last vertex."""
    number = int(field.split("/", 1)[0])
    index = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= index < count:
        raise ValueError(f"the face names vertex {number}, and {count} were given so far")
    return index


def _fan(corners: list[int]) -> list[tuple[int, int, int]]:
    if len(corners) < 3:
        raise ValueError("a face needs three corners")
    return [(corners[0], a, b) for a, b in pairwise(corners[1:])]


def _compact(vertices: list[tuple[float, ...]], triangles: list[tuple[int, int, int]]) -> Mesh:
    """A mesh of only those vertices that its triangles use."""
    used, rows = np.unique(triangles, return_inverse=True)
    return Mesh(np.array(vertices, dtype=np.float64)[used], rows.reshape(-1, 3).astype(np.int32))
