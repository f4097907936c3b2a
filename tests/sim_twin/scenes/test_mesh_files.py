import json
import struct
from contextlib import suppress

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from robotcell.errors import ConfigError
from sim_twin.scenes.mesh_files import load_meshes
from sim_twin.scenes.meshes import MESH_SUFFIXES, mesh_volume
from sim_twin.scenes.shapes import load_shape
from tests.sim_twin.mutation import mutated

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


def written(tmp_path, text):
    path = tmp_path / "mesh.obj"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_obj_file_may_have_quads_normals_and_negative_indices(tmp_path):
    (cube,) = load_meshes(written(tmp_path, CUBE_OBJ))
    assert mesh_volume(cube) == pytest.approx(1.0)
    assert len(cube.triangles) == 12


def test_a_mesh_that_is_inside_out_is_turned(tmp_path):
    lines = CUBE_OBJ.splitlines()
    inverted = [" ".join(["f", *reversed(line.split()[1:])]) if line[0] == "f" else line for line in lines]
    (cube,) = load_meshes(written(tmp_path, "\n".join(inverted)))
    assert mesh_volume(cube) == pytest.approx(1.0)


def test_objects_that_are_closed_only_together_are_one_mesh(tmp_path):
    (cube,) = load_meshes(written(tmp_path, CUBE_OBJ.replace("f 3 4 8 7", "o rest\nf 3 4 8 7")))
    assert mesh_volume(cube) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 zero\nf 1 1 1\n", "cannot be read as OBJ.*export the mesh again"),
        (CUBE_OBJ.replace("v 1 1 1", "v 1 1 nan"), "a coordinate is not a finite number"),
        ("v 0 0 0\nf 1 2 3\n", "a face names a vertex that is not in the file"),
        (CUBE_OBJ.replace("f 3 4 8 7", "f 3 4 8 99"), "a face names a vertex"),
        (CUBE_OBJ + CUBE_OBJ, "write all vertices before"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 5001 * "f 1 2 3\n", "5001 triangles; simplify the mesh to at most 5000"),
        ("", "holds no faces"),
        ("v 0 0 0\n", "holds no faces"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not closed"),
        (CUBE_OBJ.replace("f 3 4 8 7\n", ""), "not closed"),
        (CUBE_OBJ.replace("f 3 4 8 7\n", "f 7 8 4 3\n").replace("f 1//1 2//1 6//1 5//1", "f 5 6 2 1"), "disagree"),
    ],
)
def test_a_malformed_obj_file_is_refused_with_file_and_reason(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as refusal:
        load_meshes(written(tmp_path, text))
    assert "mesh.obj" in str(refusal.value)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_a_missing_mesh_file_is_refused(tmp_path, suffix):
    with pytest.raises(ConfigError, match="no such file"):
        load_meshes(tmp_path / f"none{suffix}")


def test_a_format_that_is_not_read_is_refused_with_those_that_are(tmp_path):
    (tmp_path / "part.step").write_text("ISO-10303-21;")
    with pytest.raises(ConfigError, match=r"part\.step: no mesh file.*\.stl, \.ply, \.glb, \.dae"):
        load_meshes(tmp_path / "part.step")


def exported(scene, suffix):
    item = scene.to_mesh() if suffix == ".dae" else scene
    data = item.export(file_type=suffix[1:])
    return data.encode() if isinstance(data, str) else data


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_every_format_gives_the_same_solid(tmp_path, suffix):
    path = tmp_path / f"Block{suffix.upper()}"
    path.write_bytes(exported(trimesh.Scene([trimesh.creation.box((0.05, 0.04, 0.03))]), suffix))
    shape = load_shape(path)
    assert shape.name == "Block"
    assert shape.volume_m3 == pytest.approx(0.05 * 0.04 * 0.03, rel=1e-5)
    np.testing.assert_allclose(np.ptp(shape.mesh.vertices, axis=0), (0.05, 0.04, 0.03), rtol=1e-5)
    assert len(shape.mesh.vertices) == 8
    assert len(shape.mesh.triangles) == 12


def test_objects_of_a_glb_stand_where_its_scene_puts_them(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 0.06):
        scene.add_geometry(
            trimesh.creation.box((0.04, 0.04, 0.04)), transform=trimesh.transformations.translation_matrix((x, 0, 0))
        )
    (tmp_path / "pair.glb").write_bytes(exported(scene, ".glb"))
    shape = load_shape(tmp_path / "pair.glb")
    assert len(shape.parts) == 2
    np.testing.assert_allclose(np.ptp(shape.mesh.vertices, axis=0), (0.10, 0.04, 0.04), rtol=1e-5)


def test_a_dae_file_says_its_own_unit(tmp_path):
    data = exported(trimesh.Scene([trimesh.creation.box((50, 40, 30))]), ".dae")
    (tmp_path / "mm.dae").write_bytes(data.replace(b"<up_axis>", b'<unit name="millimeter" meter="0.001"/><up_axis>'))
    np.testing.assert_allclose(
        np.ptp(load_shape(tmp_path / "mm.dae").mesh.vertices, axis=0), (0.05, 0.04, 0.03), rtol=1e-5
    )


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@pytest.mark.parametrize("cut", [0, 5, 90, 300])
def test_a_file_that_was_cut_short_is_never_more_than_a_config_error(tmp_path, suffix, cut, capfd):
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(exported(trimesh.Scene([trimesh.creation.box((0.05, 0.04, 0.03))]), suffix)[:cut])
    with pytest.raises(ConfigError, match=f"mesh{suffix}"):
        load_meshes(path)
    assert capfd.readouterr() == ("", "")


@given(data=st.binary(max_size=200), suffix=st.sampled_from(MESH_SUFFIXES))
def test_garbage_in_any_format_is_never_more_than_a_config_error(tmp_path_factory, data, suffix):
    path = tmp_path_factory.getbasetemp() / f"garbage{suffix}"
    path.write_bytes(data)
    with suppress(ConfigError):
        load_meshes(path)


def test_a_line_may_be_continued_on_the_next(tmp_path):
    for end in ("\n", "\r\n"):
        text = CUBE_OBJ.replace("f 4 3 2 1", f"f 4 3 \\{end} 2 1").replace("v 1 1 1", f"v 1 \\{end}1 1")
        path = tmp_path / "mesh.obj"
        path.write_bytes(text.encode())
        (cube,) = load_meshes(path)
        assert mesh_volume(cube) == pytest.approx(1.0)
        assert len(cube.triangles) == 12


@given(text=st.text(alphabet="vfo /-0123.\n#", max_size=80))
def test_garbage_is_never_more_than_a_config_error(tmp_path_factory, text):
    with suppress(ConfigError):
        load_meshes(written(tmp_path_factory.getbasetemp(), text))


def test_an_obj_file_may_begin_with_a_byte_order_mark(tmp_path):
    assert len(load_meshes(written(tmp_path, "\ufeff" + CUBE_OBJ))) == 1


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
        (mesh,) = load_meshes(written(tmp_path, "\n".join(lines)))
        assert mesh_volume(mesh) == pytest.approx(10)
        assert edges_match(mesh)
        # No triangle of front and back lies over a notch.
        corners = mesh.vertices[mesh.triangles]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        assert areas.sum() == pytest.approx(2 * 10 + 22)


def edges_match(mesh):
    edges = {(int(t[i]), int(t[i - 2])) for t in mesh.triangles for i in range(3)}
    return len(edges) == 3 * len(mesh.triangles) and all((b, a) in edges for a, b in edges)


@pytest.mark.parametrize(("factor", "message"), [(1000, "extent 50 m.*read in metres"), (0.01, "extent 0.0005 m")])
def test_a_mesh_in_other_units_is_refused(tmp_path, factor, message):
    lines = (
        " ".join(["v", *(str(0.05 * factor * float(x)) for x in line.split()[1:])]) if line.startswith("v ") else line
        for line in CUBE_OBJ.splitlines()
    )
    with pytest.raises(ConfigError, match=message):
        load_shape(written(tmp_path, "\n".join(lines)))


def test_a_backslash_continues_a_line(tmp_path):
    text = CUBE_OBJ.replace("f 4 3 2 1", "f 4 3 \\\n2 1").replace("v 1 0 0\n", "v 1 \\\r\n0 0\n")
    (mesh,) = load_meshes(written(tmp_path, text))
    assert mesh_volume(mesh) == pytest.approx(1)


def glb(change):
    """A box as a GLB file whose description was changed."""
    data = bytes(trimesh.creation.box((0.05, 0.04, 0.03)).export(file_type="glb"))
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def ask_for_zeros(document):
    for accessor in document["accessors"]:
        del accessor["bufferView"]
        accessor["count"] = 2_000_000_000


def use_often(document):
    (mesh,) = (node["mesh"] for node in document["nodes"] if "mesh" in node)
    first = len(document["nodes"])
    document["nodes"] += [{"mesh": mesh} for _ in range(500)]
    document["scenes"][0]["nodes"] += range(first, first + 500)


@pytest.mark.parametrize(("change", "message"), [(ask_for_zeros, "array of 2000000000"), (use_often, "6012 triangles")])
def test_a_small_file_cannot_ask_for_much_memory(tmp_path, change, message):
    path = tmp_path / "mesh.glb"
    path.write_bytes(glb(change))
    with pytest.raises(ConfigError, match=message):
        load_meshes(path)
