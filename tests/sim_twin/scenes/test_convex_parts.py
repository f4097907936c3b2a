from itertools import product

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from robotcell.geometry.transforms import rotvec_to_matrix
from sim_twin.scenes.convex_parts import convex_parts
from sim_twin.scenes.meshes import Mesh
from sim_twin.scenes.shapes import block


def solid_of_cells(cells, edge):
    """The surface of cubes (I, J, K) of bool in squares, without those between two cubes."""
    padded = np.pad(cells, 1)
    triangles = []
    for cell, axis, step in product(np.argwhere(padded), range(3), (0, 1)):
        beyond = cell.copy()
        beyond[axis] += 2 * step - 1
        if not padded[tuple(beyond)]:
            square = np.tile(cell, (4, 1))
            square[:, axis] += step
            square[:, (axis + 1) % 3] += (0, 1, 1, 0)
            square[:, (axis + 2) % 3] += (0, 0, 1, 1)
            square = square if step else square[::-1]
            triangles += [square[[0, 1, 2]], square[[0, 2, 3]]]
    vertices, rows = np.unique(np.concatenate(triangles) - 1, axis=0, return_inverse=True)
    return Mesh(edge * vertices, rows.reshape(-1, 3).astype(np.int32))


def slab(*rows):
    return np.repeat(np.array([[mark == "#" for mark in row] for row in rows])[:, :, None], 2, axis=2)


OPEN_BOX = np.ones((4, 4, 4), bool)
OPEN_BOX[1:3, 1:3, 1:] = False
CELLS = {
    "open box": OPEN_BOX,
    "frame": slab("###", "#.#", "###"),
    "U": slab("#.#", "#.#", "###"),
    "plus": slab(".#.", "###", ".#."),
    "E": slab("###", "#..", "##.", "#..", "###"),
}


def covered(points, parts):
    planes = [ConvexHull(part.vertices).equations for part in parts]
    return np.any([(points @ p[:, :3].T + p[:, 3] < 1e-9).all(axis=1) for p in planes], axis=0)


# Each takes CoACD a second or two. It cuts along the axes: those that are turned show that it finds those of the solid.
STRAIGHT, TURNED = (0, 0, 0), (0.3, 0.2, 0.5)


@pytest.mark.parametrize(
    ("name", "rotvec"), [("open box", TURNED), ("frame", TURNED), ("U", STRAIGHT), ("plus", STRAIGHT), ("E", TURNED)]
)
def test_the_parts_cover_a_concave_solid_and_little_else(name, rotvec):
    cells, edge, R = CELLS[name], 0.015, rotvec_to_matrix(rotvec)
    mesh = solid_of_cells(cells, edge)
    parts = convex_parts(Mesh(mesh.vertices @ R.T, mesh.triangles))
    points = np.random.default_rng(1).uniform((0, 0, 0), cells.shape, (20000, 3))
    within = cells[tuple(points.astype(int).T)]
    found = covered(edge * points @ R.T, parts)
    assert found[within].mean() > 0.99
    assert (found & ~within).sum() < 0.05 * within.sum()
    assert len(parts) <= 16


def test_the_parts_of_an_arch_leave_its_opening_free():
    mesh = block("arch").mesh
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    points = np.random.default_rng(1).uniform(low, high, (20000, 3))
    within = np.hypot(points[:, 0] - (low[0] + high[0]) / 2, points[:, 2] - low[2]) > 0.025
    found = covered(points, convex_parts(mesh))
    assert found[within].mean() > 0.97
    assert (found & ~within).sum() < 0.05 * within.sum()


def test_the_same_mesh_has_the_same_parts():
    mesh = block("arch").mesh
    first, again = convex_parts(mesh), convex_parts(Mesh(mesh.vertices.copy(), mesh.triangles.copy()))
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first, again, strict=True))


def test_a_convex_mesh_is_its_own_part():
    (part,) = convex_parts(block("cylinder").mesh)
    np.testing.assert_array_equal(part.vertices, block("cylinder").mesh.vertices)
