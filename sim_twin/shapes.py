"""The solids of the twin: what is rendered, and the convex pieces that collide.

A shape's frame has its origin in the centre of mass, the density being uniform. Metres, kilograms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from robotcell.geometry import Array

# Light wood; the public block scenes were fitted with it.
DEFAULT_DENSITY_KG_M3 = 400.0
# A mesh whose hull is larger than itself by more than this share collides in pieces.
CONCAVITY_TOLERANCE = 0.02

_MAX_PARTS = 24
_CUTS_PER_AXIS = 9
_CIRCLE_SEGMENTS = 32


@dataclass(frozen=True)
class Mesh:
    """A closed triangle mesh, outward normals by the right-hand rule.

    Attributes:
        vertices: (N, 3) float64 [m].
        triangles: (M, 3) int32, rows of `vertices`.
    """

    vertices: Array
    triangles: npt.NDArray[np.int32]


@dataclass(frozen=True)
class Shape:
    """A rigid solid; mesh and parts are in the shape's frame.

    Attributes:
        name: of the block, or of the file it came from.
        mesh: what is rendered.
        parts: convex pieces that together collide as the solid.
        density_kg_m3: uniform.
        volume_m3: of the solid.
    """

    name: str
    mesh: Mesh
    parts: tuple[Mesh, ...]
    density_kg_m3: float
    volume_m3: float


def block(name: str) -> Shape:
    """One of the eight blocks of the block scenes, see `BLOCK_NAMES`.

    Extents along the frame's axes [mm], those of the published block set: triangular_prism 93 x 50 x 49 (its
    triangle in xz), arch 100 x 50 x 50 (open towards -z), hexagonal_slab 25 x 60 x 60, plank 100 x 50 x 25,
    cube 50, tall_block 50 x 50 x 100, half_round_slab 50 x 50 x 25 (its dome along y), cylinder of diameter 45
    and height 50.

    Raises:
        ConfigError: there is no block of that name.
    """
    if name not in BLOCK_NAMES:
        raise ConfigError(f"no block is called {name!r}; there are {', '.join(BLOCK_NAMES)}")
    return _block(name)


def solid(name: str, pieces: tuple[Mesh, ...], density_kg_m3: float = DEFAULT_DENSITY_KG_M3) -> Shape:
    """A shape from closed meshes, each of them decomposed if it is concave, moved to the centre of mass.

    Args:
        name: of the shape.
        pieces: closed meshes that make up the solid and do not overlap much.
        density_kg_m3: uniform.

    Raises:
        ValueError: a piece is flat, or not closed.
    """
    outward = tuple(_oriented(piece) for piece in pieces)
    parts = tuple(part for piece in outward for part in convex_parts(piece))
    return _centred(name, _joined(outward), parts, density_kg_m3)


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
    moments = np.einsum("m,mci,mcj->ij", volumes, corners, corners) + np.einsum(
        "m,mi,mj->ij", volumes, sums, sums
    )
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
    return np.asarray(np.einsum("mi,mi->m", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def _oriented(mesh: Mesh) -> Mesh:
    """The mesh with outward normals."""
    volume = mesh_volume(mesh)
    limit = _hull_volume(mesh.vertices)
    # A share of the hull that no closed block falls below; an open surface gives any number.
    if not 0.01 * limit < abs(volume) < 1.001 * limit:
        raise ValueError("the surface is not closed, or it is flat")
    return mesh if volume > 0 else Mesh(mesh.vertices, mesh.triangles[:, ::-1])


def _joined(meshes: tuple[Mesh, ...]) -> Mesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]
        ).astype(np.int32),
    )


def _centred(name: str, mesh: Mesh, parts: tuple[Mesh, ...], density_kg_m3: float) -> Shape:
    centre = mesh_centroid(mesh)
    return Shape(
        name=name,
        mesh=Mesh(mesh.vertices - centre, mesh.triangles),
        parts=tuple(Mesh(part.vertices - centre, part.triangles) for part in parts),
        density_kg_m3=density_kg_m3,
        volume_m3=mesh_volume(mesh),
    )


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """The eight corners of a box."""
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T


def _extruded(outline: Array, length: float, axis: int) -> Mesh:
    """A convex prism: an outline (N, 2) [m] in the plane of the two axes after `axis`, centred along it."""
    points = np.zeros((2, len(outline), 3))
    points[:, :, (axis + 1) % 3] = outline[:, 0]
    points[:, :, (axis + 2) % 3] = outline[:, 1]
    points[0, :, axis], points[1, :, axis] = -length / 2, length / 2
    return hull(points.reshape(-1, 3))


def _arc(radius: float, start: float, end: float, segments: int) -> Array:
    angles = np.linspace(start, end, segments + 1)
    return np.asarray(radius * np.column_stack([np.cos(angles), np.sin(angles)]))


def _arch() -> tuple[Mesh, tuple[Mesh, ...]]:
    """A 100 x 50 x 50 mm block with a half-round opening of radius 25 mm along y, and its three pieces.

    The pieces (two legs and a lintel) line the opening with a trapezoid that stays within 4 mm of the arc.
    """
    arc = _arc(0.025, math.pi, 0.0, _CIRCLE_SEGMENTS // 2) + np.array([0.0, -0.025])
    top = np.column_stack([np.linspace(-0.025, 0.025, len(arc)), np.full(len(arc), 0.025)])
    # The front in strips over the opening and the legs; columns are x and z, counter-clockwise seen from -y.
    inner = np.concatenate([[(-0.05, -0.025)], arc, [(0.05, -0.025)]])
    outer = np.concatenate([[(-0.05, 0.025)], top, [(0.05, 0.025)]])
    n = len(inner)
    vertices = np.array([(x, y, z) for y in (-0.025, 0.025) for x, z in (*inner, *outer)])
    quads = []
    for i in range(n - 1):
        front = (i, i + 1, n + i + 1, n + i)
        quads += [front, tuple(2 * n + j for j in reversed(front))]
        quads += [(i + 1, i, 2 * n + i, 2 * n + i + 1), (n + i, n + i + 1, 3 * n + i + 1, 3 * n + i)]
    quads += [(0, n, 3 * n, 2 * n), (2 * n - 1, n - 1, 3 * n - 1, 4 * n - 1)]
    triangles = np.array(
        [corners for a, b, c, d in quads for corners in ((a, b, c), (a, c, d))], dtype=np.int32
    )
    leg = np.array([(-0.025, -0.05), (-0.025, -0.025), (0.0, -0.013), (0.0, -0.05)])  # (z, x)
    lintel = hull(_box((-0.05, -0.025, 0.0), (0.05, 0.025, 0.025)))
    parts = (_extruded(leg, 0.05, axis=1), _extruded(leg * (1, -1), 0.05, axis=1), lintel)
    return Mesh(vertices, triangles), parts


def _box_block(x: float, y: float, z: float) -> Mesh:
    return hull(_box((0.0, 0.0, 0.0), (x, y, z)))


def _triangular_prism() -> Mesh:
    return _extruded(np.array([(0.0, -0.0465), (0.0, 0.0465), (0.049, 0.0)]), 0.05, axis=1)


def _hexagonal_slab() -> Mesh:
    half = np.array([(0.03, 0.0), (0.015, 0.03), (-0.015, 0.03)])
    return _extruded(np.concatenate([half, -half]), 0.025, axis=0)


def _half_round_slab() -> Mesh:
    return _extruded(_arc(0.025, -math.pi / 2, math.pi / 2, _CIRCLE_SEGMENTS // 2), 0.05, axis=1)


def _cylinder() -> Mesh:
    return _extruded(_arc(0.0225, 0.0, 2 * math.pi, _CIRCLE_SEGMENTS)[:-1], 0.05, axis=2)


_CONVEX = {
    "triangular_prism": _triangular_prism,
    "hexagonal_slab": _hexagonal_slab,
    "plank": lambda: _box_block(0.1, 0.05, 0.025),
    "cube": lambda: _box_block(0.05, 0.05, 0.05),
    "tall_block": lambda: _box_block(0.05, 0.05, 0.1),
    "half_round_slab": _half_round_slab,
    "cylinder": _cylinder,
}

BLOCK_NAMES: tuple[str, ...] = (
    "triangular_prism",
    "arch",
    "hexagonal_slab",
    "plank",
    "cube",
    "tall_block",
    "half_round_slab",
    "cylinder",
)


@cache
def _block(name: str) -> Shape:
    mesh, parts = _arch() if name == "arch" else (_CONVEX[name](), ())
    return _centred(name, mesh, parts or (mesh,), DEFAULT_DENSITY_KG_M3)
