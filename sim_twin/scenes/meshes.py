"""Closed triangle meshes: volume, inertia, hulls, convex pieces, and reading them from OBJ files. Metres."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.geometry.transforms import Array

# A mesh whose hull is larger than itself by more than this share collides in pieces.
CONCAVITY_TOLERANCE = 0.02

# What an OBJ file may hold: cutting a torus of 3600 triangles takes some seconds.
MAX_TRIANGLES = 5000

_MAX_CORNERS = 300
# Share of an outline's bounding box below which a triangle has no area.
_COLLINEAR = 1e-9
_MAX_PARTS = 24
_CUTS_PER_AXIS = 5
_SAMPLES = 3000
# Steps of an evenly spread sequence: powers of the root of g^4 = g + 1 (M. Roberts, "The unreasonable effectiveness
# of quasirandom sequences", 2018).
_LATTICE = 1.2207440846057596 ** -np.arange(1.0, 4.0)
# Corners this close to a cutting plane are in it.
_SNAP_M = 1e-6
_NUDGE = np.array([1.0, 0.62, 0.38]) * 1e-3
# Normals with such a cosine are of parallel faces.
_PARALLEL = 0.999
_AXIS_CANDIDATES = 200
# Pairs of points and triangles that are tested at once.
_CHUNK = 500_000
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

    Vertices and faces are read (flat polygons, `v/vt/vn` and negative indices included), the rest is not.
    Objects that are closed only together come as one mesh.

    Raises:
        ConfigError: the file is missing or malformed, with the line; a mesh in it is not closed, or its faces
            disagree about which side is outside; there are more than `MAX_TRIANGLES`.
    """
    vertices: list[tuple[float, ...]] = []
    objects: list[list[tuple[int, int, int]]] = [[]]
    for number, line in enumerate(_lines(path), start=1):
        keyword, *fields = line.split("#", 1)[0].split() or [""]
        try:
            if keyword == "v":
                vertices.append(_vertex(fields))
            elif keyword == "f":
                objects[-1] += _triangles([_index(field, len(vertices)) for field in fields], vertices)
            elif keyword == "o":
                objects.append([])
        except ValueError as error:
            raise ConfigError(f"{path}, line {number}: {error}: {line.strip()[:80]!r}") from None
    count = sum(map(len, objects))
    if count > MAX_TRIANGLES:
        raise ConfigError(f"{path}: {count} triangles; simplify the mesh to at most {MAX_TRIANGLES}")
    meshes = tuple(_compact(vertices, triangles) for triangles in objects if triangles)
    if not meshes:
        raise ConfigError(f"{path}: holds no faces; a closed mesh is needed")
    if not all(_is_closed(mesh) for mesh in meshes):
        meshes = (join(meshes),)
    if not all(_is_closed(mesh) for mesh in meshes):
        raise ConfigError(f"{path}: the surface is flat or not closed; a closed mesh is needed")
    if not all(_is_consistent(mesh) for mesh in meshes):
        raise ConfigError(f"{path}: neighbouring faces disagree about which side is outside; recalculate the normals")
    return tuple(_outward(mesh) for mesh in meshes)


def parse_number(field: str) -> float:
    """A finite number in plain ASCII notation.

    Raises:
        ValueError: it is none; Python's own `1_000` and foreign digits count as none.
    """
    try:
        if "_" in field or not field.isascii():
            raise ValueError
        number = float(field)
    except ValueError:
        raise ValueError(f"{field[:40]!r}, which is no number") from None
    if not np.isfinite(number):
        raise ValueError(f"{field[:40]!r}; it must be finite")
    return number


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
    """Convex pieces that together cover a closed mesh: its hull, where that hardly differs from it.

    A concave mesh is cut across the directions of its largest flat sides, first where that frees most of what the
    hulls of the pieces fill besides the mesh, until that is at most `CONCAVITY_TOLERANCE` of it or there are
    `_MAX_PARTS` pieces. What is filled is counted on a lattice of sample points.

    Raises:
        ValueError: the mesh is flat.
    """
    whole = hull(mesh.vertices)
    if mesh_volume(whole) <= (1 + CONCAVITY_TOLERANCE) * mesh_volume(mesh):
        return (whole,)
    R = _flat_axes(mesh)
    vertices = mesh.vertices @ R
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    samples = low + np.mod(np.outer(np.arange(1, _SAMPLES + 1), _LATTICE), 1) * (high - low)
    solid = vertices[mesh.triangles]
    inside = _inside(solid, samples)
    body = _Body(solid, samples[inside], samples[~inside])
    pieces = [_piece(body, solid, low, high)]
    while len(pieces) < _MAX_PARTS and sum(piece.free for piece in pieces) > CONCAVITY_TOLERANCE * inside.sum():
        worst = max(pieces, key=lambda piece: piece.free)
        pieces.remove(worst)
        pieces += _halves(body, worst)
    return tuple(hull(piece.corners @ R.T) for piece in pieces)


def _flat_axes(mesh: Mesh) -> Array:
    """Orthonormal axes (3, 3), as columns: the normal of most of the surface, and of most of what is square to it."""
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    normals = normals[areas > 0] / areas[areas > 0, None]
    candidates = normals[np.argsort(-areas[areas > 0], kind="stable")[:_AXIS_CANDIDATES]]
    weights = (np.abs(candidates @ normals.T) > _PARALLEL) @ areas[areas > 0]
    x = candidates[np.argmax(weights)]
    y = candidates[np.argmax(weights * (np.abs(candidates @ x) < 1 - _PARALLEL))]
    # Where nothing is square to x, whatever direction is.
    y = y if abs(y @ x) < 1 - _PARALLEL else np.linalg.svd(x[None])[2][1]
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


@dataclass(frozen=True)
class _Body:
    """A mesh to be cut: triangles (M, 3, 3), and sample points (N, 3) within it and beside it [m]."""

    triangles: Array
    within: Array
    beside: Array


@dataclass(frozen=True, eq=False)
class _Piece:
    """What of a body lies in a box, and how many of its samples: those of the body, and those the hull adds.

    Attributes:
        triangles: (M, 3, 3) the body's surface in the box [m].
        low: (3,) corner of the box [m].
        high: (3,) opposite corner of the box [m].
        corners: (N, 3) what the hull of the piece is that of; none where it encloses no volume.
        solid: samples of the body in the box.
        free: samples beside the body in the hull.
    """

    triangles: Array
    low: Array
    high: Array
    corners: Array
    solid: int
    free: int


def _piece(body: _Body, triangles: Array, low: Array, high: Array) -> _Piece:
    # The corners of a body in a box are those of its surface there, and those of the box that are in the body.
    box = np.array(list(product(*zip(low, high, strict=True))))
    # Off the box's own planes, where faces of the body may lie, and off the diagonals of those.
    nudged = box + _NUDGE * ((low + high) / 2 - box)
    corners = np.concatenate([triangles.reshape(-1, 3), box[_inside(body.triangles, nudged)]])
    solid = int(((body.within >= low) & (body.within <= high)).all(axis=1).sum())
    try:
        planes = ConvexHull(corners).equations
    except (QhullError, ValueError):
        return _Piece(triangles, low, high, np.zeros((0, 3)), solid, 0)
    near = body.beside[((body.beside >= low) & (body.beside <= high)).all(axis=1)]
    free = int((near @ planes[:, :3].T + planes[:, 3] < 0).all(axis=1).sum())
    return _Piece(triangles, low, high, corners, solid, free)


def _halves(body: _Body, piece: _Piece) -> list[_Piece]:
    """A piece cut in two; a half that encloses no volume is left out.

    The best cut frees most samples; among equals the one whose halves without free samples hold most of the body,
    so that a wall is taken off where no single cut frees anything; then the one nearest the middle.
    """
    best: tuple[tuple[float, ...], list[_Piece]] | None = None
    points = piece.triangles.reshape(-1, 3)
    for axis in range(3):
        low, high = piece.low[axis], piece.high[axis]
        levels, counts = np.unique(points[:, axis].round(6), return_counts=True)
        # Steps of the surface are levels that many of its corners share.
        steps = levels[np.argsort(-counts, kind="stable")[:_CUTS_PER_AXIS]]
        for at in (*np.linspace(low, high, _CUTS_PER_AXIS + 2)[1:-1], *steps):
            if not low + _SNAP_M < at < high - _SNAP_M:
                continue
            to, start = piece.high.copy(), piece.low.copy()
            to[axis] = start[axis] = at
            halves = [
                _piece(body, _clip(piece.triangles, axis, at, -1.0), piece.low, to),
                _piece(body, _clip(piece.triangles, axis, at, 1.0), start, piece.high),
            ]
            done = sum(half.solid for half in halves if half.free == 0)
            score = (-sum(half.free for half in halves), done, -abs(at - (low + high) / 2))
            if best is None or score > best[0]:
                best = score, halves
    return [half for half in best[1] if len(half.corners)] if best else []


def _clip(triangles: Array, axis: int, at: float, side: float) -> Array:
    """The parts (N, 3, 3) of triangles (M, 3, 3) on one side of a plane.

    Triangles in the plane belong to the side that they bound from outside.
    """
    distance = side * (triangles[:, :, axis] - at)
    distance[np.abs(distance) < _SNAP_M] = 0
    kept = distance >= 0
    edges = triangles[:, 1:] - triangles[:, :1]
    outward = side * np.cross(edges[:, 0], edges[:, 1])[:, axis]
    whole = kept.all(axis=1) & ((distance > 0).any(axis=1) | (outward < 0))
    crossed = (distance > 0).any(axis=1) & ~kept.all(axis=1)
    # Of a crossed triangle, a is the corner that is alone on its side.
    alone = np.where(kept.sum(axis=1, keepdims=True) == 1, kept, ~kept)[crossed]
    order = (np.argmax(alone, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles[crossed], order[:, :, None], axis=1).swapaxes(0, 1)
    da, db, dc = np.take_along_axis(distance[crossed], order, axis=1).T[..., None]
    ab, ac = a + da / (da - db) * (b - a), a + da / (da - dc) * (c - a)
    tip = da[:, 0] >= 0
    parts = [np.stack(corners, axis=1) for corners in ((a, ab, ac), (ab, b, c), (ab, c, ac))]
    return np.concatenate([triangles[whole], parts[0][tip], parts[1][~tip], parts[2][~tip]])


def _inside(triangles: Array, points: Array) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) a closed surface (M, 3, 3) encloses: more of it faces up than down above them."""
    found = []
    for chunk in np.array_split(points, 1 + len(points) * len(triangles) // _CHUNK):
        x, y = ((triangles[None, :, :, i] - chunk[:, None, None, i]) for i in (0, 1))
        # Twice the signed areas that the point makes with the triangle's edges, seen from above.
        areas = np.roll(x, -1, axis=2) * np.roll(y, -2, axis=2) - np.roll(x, -2, axis=2) * np.roll(y, -1, axis=2)
        turn = (areas > 0).all(axis=2).astype(int) - (areas < 0).all(axis=2)
        total = areas.sum(axis=2)
        height = np.einsum("nmi,mi->nm", areas, triangles[:, :, 2]) / np.where(turn == 0, 1, total)
        found.append((turn * (height > chunk[:, None, 2])).sum(axis=1) > 0)
    return np.concatenate(found)


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


def _is_consistent(mesh: Mesh) -> bool:
    # Two faces pass the edge between them in opposite directions. An edge that one face more passes in one direction
    # is a crack.
    places, rows = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = rows.reshape(-1)[mesh.triangles]
    starts, ends = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    edges, index = np.unique(np.minimum(starts, ends) * len(places) + np.maximum(starts, ends), return_inverse=True)
    surplus = np.bincount(index.reshape(-1), weights=np.sign(ends - starts), minlength=len(edges))
    return bool((np.abs(surplus) < 2).all())


def _outward(mesh: Mesh) -> Mesh:
    return mesh if mesh_volume(mesh) > 0 else Mesh(mesh.vertices, mesh.triangles[:, ::-1])


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such mesh file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text: {error}") from error


def _vertex(fields: list[str]) -> tuple[float, ...]:
    if len(fields) < 3:
        raise ValueError("a vertex needs three numbers")
    try:
        return tuple(parse_number(field) for field in fields[:3])
    except ValueError as error:
        raise ValueError(f"a coordinate is {error}") from None


def _index(field: str, count: int) -> int:
    """Row of the vertex that a face names; OBJ counts from 1, or back from the last vertex."""
    name = field.split("/", 1)[0]
    if not re.fullmatch("-?[0-9]{1,9}", name):
        raise ValueError(f"the face names {name[:40]!r}, which is no vertex")
    number = int(name)
    index = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= index < count:
        raise ValueError(f"the face names vertex {number}, and {count} were given so far")
    return index


def _triangles(corners: list[int], vertices: list[tuple[float, ...]]) -> list[tuple[int, int, int]]:
    """A flat polygon in triangles: its ears are cut off one by one (G. Meisters, 1975).

    Raises:
        ValueError: there are fewer than three corners, or too many, or the outline crosses itself.
    """
    if not 3 <= len(corners) <= _MAX_CORNERS:
        raise ValueError(f"a face needs three corners, and at most {_MAX_CORNERS}; it has {len(corners)}")
    if len(corners) == 3:
        return [(corners[0], corners[1], corners[2])]
    points = np.array([vertices[corner] for corner in corners])
    points -= points[0]
    # Newell's normal; seen against it, the outline turns counter-clockwise.
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    drop = int(np.argmax(np.abs(normal)))
    flat = points[:, [(drop + 1) % 3, (drop + 2) % 3]] * (1, np.sign(normal[drop]) or 1)
    left, ears = list(range(len(corners))), []
    while len(left) >= 3:
        n = len(left)
        ear = next((i for i in range(n) if _is_ear(flat[left], i)), None)
        if ear is None:
            raise ValueError("the outline of the face crosses itself")
        ears.append((left[ear - 1], left[ear], left[(ear + 1) % n]))
        del left[ear]
    return [(corners[a], corners[b], corners[c]) for a, b, c in ears]


def _is_ear(outline: Array, i: int) -> bool:
    """Whether the triangle at corner i of an outline (N, 2) lies in it, and no other corner in or on the triangle."""
    a, b, c = (outline[k % len(outline)] for k in (i - 1, i, i + 1))
    sides = np.array([_turn(a, b, outline), _turn(b, c, outline), _turn(c, a, outline)])
    slack = _COLLINEAR * np.ptp(outline, axis=0).prod()
    # Outlines of faces with holes pass some corners twice.
    others = ~(outline[:, None] == (a, b, c)).all(axis=2).any(axis=1)
    return bool(_turn(a, b, c) >= -slack and not (others & (sides >= -slack).all(axis=0)).any())


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Twice the signed area of the triangle of a, b and each of c (..., 2)."""
    return np.asarray((b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0]))


def _compact(vertices: list[tuple[float, ...]], triangles: list[tuple[int, int, int]]) -> Mesh:
    """A mesh of only those vertices that its triangles use."""
    used, rows = np.unique(triangles, return_inverse=True)
    return Mesh(np.array(vertices, dtype=np.float64)[used], rows.reshape(-1, 3).astype(np.int32))
