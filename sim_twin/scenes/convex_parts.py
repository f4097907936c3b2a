"""Convex pieces of concave meshes, by CoACD.

X. Wei, M. Liu, Z. Ling, H. Su, "Approximate convex decomposition for 3D meshes with collision-aware concavity and tree
search", SIGGRAPH 2022.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from sim_twin.scenes.meshes import Mesh, hull, mesh_volume

# A mesh whose hull is larger than itself by more than this share collides in pieces.
CONCAVITY_TOLERANCE = 0.02

# CoACD's own threshold of concavity, and half its search: open boxes, frames, U, E and an arch then come out within
# 2 % of their volume, in one to six seconds.
_THRESHOLD = 0.05
_SEARCH = {"mcts_iterations": 60, "mcts_nodes": 10, "resolution": 1000, "seed": 0}


def convex_parts(mesh: Mesh) -> tuple[Mesh, ...]:
    """Convex pieces that together cover a closed mesh: its hull, where that hardly differs from it.

    The same mesh has the same pieces; those of the last meshes are remembered within the process.

    Raises:
        ValueError: the mesh is flat.
    """
    whole = hull(mesh.vertices)
    if mesh_volume(whole) <= (1 + CONCAVITY_TOLERANCE) * mesh_volume(mesh):
        return (whole,)
    return _decomposed(mesh.vertices.tobytes(), mesh.triangles.astype(np.int32).tobytes())


@lru_cache(maxsize=64)
def _decomposed(vertex_bytes: bytes, triangle_bytes: bytes) -> tuple[Mesh, ...]:
    import coacd
    from trimesh import Trimesh
    from trimesh.bounds import oriented_bounds

    # Faces of one place, where a file gives each its own corners, are neighbours.
    solid = Trimesh(np.frombuffer(vertex_bytes).reshape(-1, 3), np.frombuffer(triangle_bytes, np.int32).reshape(-1, 3))
    # CoACD cuts along the axes.
    R = oriented_bounds(solid)[0][:3, :3]  # type: ignore[no-untyped-call]
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh(solid.vertices @ R.T, solid.faces), threshold=_THRESHOLD, **_SEARCH)
    return tuple(hull(vertices @ R) for vertices, _ in pieces)
