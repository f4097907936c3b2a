from contextlib import suppress
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from robotcell.errors import ConfigError
from robotcell.geometry.transforms import rotvec_to_matrix
from sim_twin.scenes.meshes import Mesh, convex_parts, hull, load_obj, mesh_centroid, mesh_inertia, mesh_volume
from sim_twin.scenes.shapes import block, load_shape
from tests.sim_twin.mutation import mutated

EDGES = np.array([0.1, 0.06, 0.02])
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * EDGES

CUBE_OBJ = """\
mtllib none.mtl
o cube   # a comment
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
vn 0 0 1
usemtl wood
f 4 3 2 1
f 5/1/1 6/2/1 7/3/1 8/4/1
f 1//1 2//1 6//1 5//1
f -7 -6 -2 -3
f 3 4 8 7
f 4 1 5 8
"""

vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


def written(tmp_path, text):
    path = tmp_path / "mesh.obj"
    path.write_text(text, encoding="utf-8")
    return path


@given(rotvec=vectors, shift=vectors)
def test_a_moved_box_keeps_its_volume_and_moments(rotvec, shift):
    R = rotvec_to_matrix(rotvec)
    box = hull(CORNERS)
    moved = Mesh(box.vertices @ R.T + shift, box.triangles)
    volume = EDGES.prod()
    squares = EDGES**2
    moments = volume / 12 * (squares.sum() - squares)
    assert mesh_volume(moved) == pytest.approx(volume, rel=1e-6)
    assert mesh_centroid(moved) == pytest.approx(R @ (EDGES / 2) + shift, abs=1e-9)
    np.testing.assert_allclose(mesh_inertia(moved), R @ np.diag(moments) @ R.T, atol=1e-6 * moments.max())


def test_an_obj_file_may_have_quads_normals_and_negative_indices(tmp_path):
    (cube,) = load_obj(written(tmp_path, CUBE_OBJ))
    assert mesh_volume(cube) == pytest.approx(1.0)
    assert len(cube.triangles) == 12


def test_a_mesh_that_is_inside_out_is_turned(tmp_path):
    lines = CUBE_OBJ.splitlines()
    inverted = [" ".join(["f", *reversed(line.split()[1:])]) if line[0] == "f" else line for line in lines]
    (cube,) = load_obj(written(tmp_path, "\n".join(inverted)))
    assert mesh_volume(cube) == pytest.approx(1.0)


def test_objects_that_are_closed_only_together_are_one_mesh(tmp_path):
    (cube,) = load_obj(written(tmp_path, CUBE_OBJ.replace("f 3 4 8 7", "o rest\nf 3 4 8 7")))
    assert mesh_volume(cube) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0\n", "line 1: a vertex needs three numbers"),
        ("v 0 0 zero\n", "line 1: a coordinate is 'zero', which is no number"),
        ("v 0 0 0_1\n", "line 1: a coordinate is '0_1'"),
        ("v 0 0 \u0661\n", "line 1: a coordinate is '\u0661'"),
        ("v 0 0 1" + 5000 * "0", "line 1: a coordinate .* must be finite"),
        ("v 0 0 nan\n", "line 1: a coordinate is 'nan'; it must be finite"),
        ("v 0 0 0\nf 1 2 3\n", "line 2: the face names vertex 2, and 1 were given"),
        ("v 0 0 0\nf 0 1 1\n", "line 2: the face names vertex 0"),
        ("v 0 0 0\nf 1 1\n", "line 2: a face needs three corners"),
        ("v 0 0 0\nf 1 1 1_0\n", "line 2: the face names '1_0'"),
        ("v 0 0 0\nf 1 1 " + 5000 * "1", "line 2: the face names"),
        ("v 0 0 0\nf" + 301 * " 1", "line 2: .*at most 300; it has 301"),
        ("v 0 0 0\nv 2 2 0\nv 2 0 0\nv 0 1 0\nf 1 2 3 4\n", "line 5: .*crosses itself"),
        ("v 0 0 0\n" + 5001 * "f 1 1 1\n", "5001 triangles; simplify the mesh to at most 5000"),
        ("v 0 0 0\n", "holds no faces"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not closed"),
        (CUBE_OBJ.replace("f 3 4 8 7\n", ""), "not closed"),
        (CUBE_OBJ.replace("f 3 4 8 7\n", "f 7 8 4 3\n").replace("f 1//1 2//1 6//1 5//1", "f 5 6 2 1"), "disagree"),
    ],
)
def test_a_malformed_obj_file_is_refused_with_the_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as refusal:
        load_obj(written(tmp_path, text))
    assert "mesh.obj" in str(refusal.value)


def test_a_missing_obj_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no such mesh file"):
        load_obj(tmp_path / "none.obj")


@given(text=st.text(alphabet="vfo /-0123.\n#", max_size=80))
def test_garbage_is_never_more_than_a_config_error(tmp_path_factory, text):
    with suppress(ConfigError):
        load_obj(written(tmp_path_factory.getbasetemp(), text))


def test_an_obj_file_may_begin_with_a_byte_order_mark(tmp_path):
    assert len(load_obj(written(tmp_path, "\ufeff" + CUBE_OBJ))) == 1


@given(data=st.data())
def test_a_mutated_obj_file_is_never_more_than_a_config_error(tmp_path_factory, data):
    text = mutated(data, CUBE_OBJ, ["1e400", "nan", "-9", "1/", "9" * 5000, "o", "f", "v", "\0", "\u0663", "0_1", "#"])
    with suppress(ConfigError):
        load_shape(written(tmp_path_factory.getbasetemp(), text))


def test_an_outline_that_is_not_convex_is_cut_as_it_is(tmp_path):
    # An E of 10 cells, its front and back each one face that no fan covers.
    outline = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (2, 2), (2, 3), (1, 3), (1, 4), (3, 4), (3, 5), (0, 5)]
    for first in range(len(outline)):
        corners = outline[first:] + outline[:first]
        lines = [f"v {x} {y} {z}" for z in (0, 1) for x, y in corners]
        n = len(corners)
        lines += ["f " + " ".join(map(str, side)) for side in (range(n, 0, -1), range(n + 1, 2 * n + 1))]
        lines += [f"f {i + 1} {(i + 1) % n + 1} {n + (i + 1) % n + 1} {n + i + 1}" for i in range(n)]
        (mesh,) = load_obj(written(tmp_path, "\n".join(lines)))
        assert mesh_volume(mesh) == pytest.approx(10)
        assert edges_match(mesh)


def edges_match(mesh):
    edges = {(int(t[i]), int(t[i - 2])) for t in mesh.triangles for i in range(3)}
    return len(edges) == 3 * len(mesh.triangles) and all((b, a) in edges for a, b in edges)


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


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0, 0, 0.4), (0.3, 0.2, 0.5)])
def test_the_parts_cover_a_concave_solid_and_little_else(name, rotvec):
    cells, edge, R = CELLS[name], 0.015, rotvec_to_matrix(rotvec)
    mesh = solid_of_cells(cells, edge)
    parts = convex_parts(Mesh(mesh.vertices @ R.T, mesh.triangles))
    points = np.random.default_rng(1).uniform((0, 0, 0), cells.shape, (20000, 3))
    within = cells[tuple(points.astype(int).T)]
    found = covered(edge * points @ R.T, parts)
    assert found[within].mean() > 0.99
    assert (found & ~within).sum() < 0.05 * within.sum()
    assert len(parts) <= 6


def test_the_parts_of_an_arch_leave_its_opening_free():
    mesh = block("arch").mesh
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    points = np.random.default_rng(1).uniform(low, high, (20000, 3))
    within = np.hypot(points[:, 0] - (low[0] + high[0]) / 2, points[:, 2] - low[2]) > 0.025
    found = covered(points, convex_parts(mesh))
    assert found[within].mean() > 0.97
    assert (found & ~within).sum() < 0.05 * within.sum()


@pytest.mark.parametrize(("factor", "message"), [(1000, "extent 50 m.*read in metres"), (0.01, "extent 0.0005 m")])
def test_a_mesh_in_other_units_is_refused(tmp_path, factor, message):
    lines = (
        " ".join(["v", *(str(0.05 * factor * float(x)) for x in line.split()[1:])]) if line.startswith("v ") else line
        for line in CUBE_OBJ.splitlines()
    )
    with pytest.raises(ConfigError, match=message):
        load_shape(written(tmp_path, "\n".join(lines)))


def test_points_in_a_plane_have_no_hull():
    with pytest.raises(ValueError, match="in a plane"):
        hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))
