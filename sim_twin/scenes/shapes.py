"""The solids of the twin: what is rendered, and the convex pieces that collide.

A shape's frame has its origin in the centre of mass, the density being uniform. Metres, kilograms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import ConfigError
from sim_twin.scenes.convex_parts import convex_parts
from sim_twin.scenes.meshes import Mesh, hull, join, mesh_centroid, mesh_volume

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.geometry.transforms import Array

__all__ = ["BLOCK_NAMES", "Mesh", "Shape", "block", "load_shape", "shape_of"]

# Light wood, as in the physics measurements that the twin's settings come from.
DEFAULT_DENSITY_KG_M3 = 400.0
_CIRCLE_SEGMENTS = 32
# The longest side of what could stand on the table.
_EXTENT_M = (0.005, 0.5)


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
    cube 50, tall_block 50 x 50 x 100, half_round_slab 50 x 50 x 25 (its dome along y), cylinder of
    diameter 45 and height 50.

    Raises:
        ConfigError: there is no block of that name.
    """
    if name not in BLOCK_NAMES:
        raise ConfigError(f"no block is called {name!r}; there are {', '.join(BLOCK_NAMES)}")
    return _block(name)


def load_shape(path: Path) -> Shape:
    """The solid of a mesh file [m], see `mesh_files`; concave objects in it collide in convex pieces.

    Raises:
        ConfigError: the file is missing or malformed, or of a size that speaks for another unit.
    """
    from sim_twin.scenes.mesh_files import load_meshes

    meshes = load_meshes(path)
    extent = float(np.ptp(join(meshes).vertices, axis=0).max())
    if not _EXTENT_M[0] <= extent <= _EXTENT_M[1]:
        raise ConfigError(
            f"{path}: extent {extent:.3g} m; it is read in metres, and a mesh must measure "
            f"{_EXTENT_M[0]} to {_EXTENT_M[1]} m"
        )
    try:
        return shape_of(path.stem, meshes)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None


def shape_of(name: str, meshes: tuple[Mesh, ...]) -> Shape:
    """A shape of closed meshes that together make up a solid, each decomposed where it is concave."""
    parts = tuple(part for mesh in meshes for part in convex_parts(mesh))
    return _centred(name, join(meshes), parts)


def _centred(name: str, mesh: Mesh, parts: tuple[Mesh, ...]) -> Shape:
    centre = mesh_centroid(mesh)
    return Shape(
        name=name,
        mesh=Mesh(mesh.vertices - centre, mesh.triangles),
        parts=tuple(Mesh(part.vertices - centre, part.triangles) for part in parts),
        density_kg_m3=DEFAULT_DENSITY_KG_M3,
        volume_m3=mesh_volume(mesh),
    )


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """The eight corners of a box."""
    return np.array(list(product(*zip(low, high, strict=True))))


def _extruded(outline: Array, length: float, axis: int) -> Mesh:
    """A convex prism: an outline (N, 2) [m] in the plane of the two axes after `axis`, centred along it."""
    points = np.zeros((2, len(outline), 3))
    points[:, :, (axis + 1) % 3] = outline[:, 0]
    points[:, :, (axis + 2) % 3] = outline[:, 1]
    points[0, :, axis], points[1, :, axis] = -length / 2, length / 2
    return hull(points.reshape(-1, 3))


def _arc(radius: float, start: float, end: float, segments: int) -> Array:
    angles = np.linspace(start, end, segments + 1)
    points: Array = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return points


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
    triangles = np.array([corners for a, b, c, d in quads for corners in ((a, b, c), (a, c, d))], dtype=np.int32)
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
    return _centred(name, mesh, parts or (mesh,))
