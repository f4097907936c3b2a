from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.errors import ConfigError
from robotcell.geometry import rotvec_to_matrix
from sim_twin.meshes import Mesh, convex_parts, hull, join, load_obj, mesh_centroid, mesh_inertia, mesh_volume

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
        ("v 0 0 zero\n", "line 1: could not convert"),
        ("v 0 0 nan\n", "line 1: a vertex needs finite"),
        ("v 0 0 0\nf 1 2 3\n", "line 2: the face names vertex 2, and 1 were given"),
        ("v 0 0 0\nf 0 1 1\n", "line 2: the face names vertex 0"),
        ("v 0 0 0\nf 1 1\n", "line 2: a face needs three corners"),
        ("v 0 0 0\n", "holds no faces"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not closed"),
        (CUBE_OBJ.replace("f 3 4 8 7\n", ""), "not closed"),
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


def test_a_concave_mesh_is_cut_into_pieces_that_fill_it():
    long_beam = hull(CORNERS)
    upright = Mesh(long_beam.vertices[:, [2, 1, 0]] + (0.1, 0, 0), long_beam.triangles[:, ::-1])
    angle = join((long_beam, upright))
    parts = convex_parts(angle)
    assert 2 <= len(parts) <= 4
    assert sum(mesh_volume(part) for part in parts) == pytest.approx(mesh_volume(angle), rel=0.021)


def test_points_in_a_plane_have_no_hull():
    with pytest.raises(ValueError, match="in a plane"):
        hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))
