"""Repairs flat faces that a reader cut into a fan of triangles although their outline has notches.

Such a fan encloses the right volume, but covers the notches as well: once forwards and once backwards. The directed
edges that it does not pass both ways are the true outline, which manifold3d cuts without overlap.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

Triangles = npt.NDArray[np.int32]

# Corners of one flat face lie in its plane within this share of the mesh's extent.
_FLAT = 1e-6
# Areas that differ by a smaller share are the same.
_SAME_AREA = 1e-6


def without_folds(vertices: Array, triangles: Triangles) -> Triangles:
    """The triangles (M, 3), with those of each plane where some are folded over others cut anew.

    Args:
        vertices: (N, 3) [m].
        triangles: (M, 3), rows of `vertices`; faces that meet share their vertices.
    """
    areas = _areas(vertices, triangles)
    sizes = np.linalg.norm(areas, axis=1)
    tolerance = _FLAT * float(np.ptp(vertices, axis=0).max())
    left = sizes > 0
    cut: list[Triangles] = []
    whole = np.ones(len(triangles), bool)
    while left.any():
        first = int(np.argmax(np.where(left, sizes, 0)))
        normal = areas[first] / sizes[first]
        near = np.abs((vertices - vertices[triangles[first, 0]]) @ normal) < tolerance
        in_plane = near[triangles].all(axis=1) & whole
        left[in_plane] = False
        left[first] = False
        if not (areas[in_plane] @ normal < 0).any():
            continue
        anew = _cut(vertices, triangles[in_plane], normal)
        if anew is not None:
            cut.append(anew)
            whole &= ~in_plane
    return np.concatenate([triangles[whole], *cut])


def _cut(vertices: Array, triangles: Triangles, normal: Array) -> Triangles | None:
    """The outline of folded triangles in one plane, cut anew; None where they are no fold but faces of either side."""
    from manifold3d import triangulate

    total = _areas(vertices, triangles).sum(axis=0)
    normal = normal if total @ normal > 0 else -normal
    loops = _outline(triangles)
    if not loops:
        return None
    # Two axes in the plane, seen against the normal.
    x = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(x, normal) / np.linalg.norm(np.cross(x, normal))
    axes = np.column_stack([x, np.cross(normal, x)])
    rows = np.concatenate(loops)
    anew = rows[triangulate([vertices[loop] @ axes for loop in loops])].astype(np.int32)
    along = _areas(vertices, anew) @ normal
    covered = np.abs(along).sum()
    return anew if abs(covered - np.linalg.norm(total)) < _SAME_AREA * covered else None


def _outline(triangles: Triangles) -> list[npt.NDArray[np.int32]]:
    """Closed loops of vertices along the directed edges that no triangle passes the other way."""
    onward: dict[int, list[int]] = defaultdict(list)
    for a, b in zip(triangles.ravel().tolist(), np.roll(triangles, -1, axis=1).ravel().tolist(), strict=True):
        if a in onward[b]:
            onward[b].remove(a)
        else:
            onward[a].append(b)
    loops = []
    for start in list(onward):
        while onward[start]:
            loop = [start]
            while (to := onward[loop[-1]].pop()) != start:
                loop.append(to)
            loops.append(np.array(loop, np.int32))
    return loops


def _areas(vertices: Array, triangles: Triangles) -> Array:
    """Area vectors (M, 3) [m2]."""
    corners = vertices[triangles]
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2)
