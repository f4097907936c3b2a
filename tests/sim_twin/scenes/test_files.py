from contextlib import suppress

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from robotcell.errors import ConfigError
from robotcell.geometry.transforms import rotvec_to_matrix, transform_points
from robotcell.perception.colors import PALETTE
from sim_twin.scenes.files import mesh_frame, read_scene
from sim_twin.scenes.meshes import Mesh, bounds_center
from sim_twin.scenes.shapes import BLOCK_NAMES, block
from tests.sim_twin.mutation import mutated

# In mesh axes, the x, y and z axes that V-REP gives the frame of each published mesh (fitted to 23 scenes).
PUBLISHED_FRAMES = {
    "triangular_prism": ("+z", "+y", "-x"),
    "arch": ("+z", "+y", "-x"),
    "hexagonal_slab": ("+x", "+y", "+z"),
    "plank": ("+z", "+y", "-x"),
    "cube": ("+x", "+y", "+z"),
    "tall_block": ("+x", "+y", "+z"),
    "half_round_slab": ("+z", "+x", "+y"),
    "cylinder": ("+z", "+y", "-x"),
}


def published_mesh(name):
    """The block as its published file has it: the cylinder lies along x there."""
    mesh = block(name).mesh
    return Mesh(mesh.vertices[:, [2, 0, 1]], mesh.triangles) if name == "cylinder" else mesh


def published_frame(name):
    axes = dict(zip("xyz", np.eye(3), strict=True))
    return np.column_stack([(1 if sign == "+" else -1) * axes[axis] for sign, axis in PUBLISHED_FRAMES[name]])


def write_obj(path, mesh):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a}//1 {b}//1 {c}//1" for a, b, c in (mesh.triangles + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    for name in BLOCK_NAMES:
        write_obj(folder / f"{name}.obj", published_mesh(name))
    return folder


def scene_of(tmp_path, text, meshes=None, suffix=".txt"):
    path = tmp_path / f"scene{suffix}"
    path.write_text(text, encoding="utf-8")
    return read_scene(path, meshes)


def corners(item):
    return transform_points(item.T_base_object, item.shape.mesh.vertices)


angles = st.floats(-3.1, 3.1)
lengths = st.floats(-0.2, 0.2)
triples = st.tuples(angles, angles, angles)
positions = st.tuples(lengths, lengths, lengths)
colors = st.sampled_from(sorted(PALETTE))


@pytest.mark.parametrize("name", BLOCK_NAMES)
def test_the_frames_are_those_of_the_published_meshes(name):
    np.testing.assert_allclose(mesh_frame(published_mesh(name)), published_frame(name), atol=1e-6)


@given(
    name=st.sampled_from(["triangular_prism", "arch", "hexagonal_slab", "plank", "half_round_slab"]),
    rotvec=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
)
def test_the_frame_turns_with_the_mesh(name, rotvec):
    R = rotvec_to_matrix(rotvec)
    mesh = published_mesh(name)
    turned = mesh_frame(Mesh(mesh.vertices @ R.T, mesh.triangles))
    np.testing.assert_allclose(turned, R @ mesh_frame(mesh), atol=1e-5)


@pytest.mark.parametrize("rotvec", [(0.4, 0, 0), (0, 0.6, 0), (0.5, -0.3, 0.7), (2.0, 1.0, 0.4)])
@pytest.mark.parametrize("name", ["hexagonal_slab", "cylinder", "tall_block", "cube"])
def test_the_frame_of_a_symmetric_mesh_is_a_right_handed_principal_frame(name, rotvec):
    R = rotvec_to_matrix(rotvec)
    mesh = published_mesh(name)
    frame = mesh_frame(Mesh(mesh.vertices @ R.T, mesh.triangles))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) > 0
    if name != "cube":
        # The axis of symmetry, or of the smallest moment, is the frame's z axis.
        assert abs(frame[:, 2] @ R @ published_frame(name)[:, 2]) == pytest.approx(1, abs=1e-6)


@given(name=st.sampled_from(BLOCK_NAMES), position=positions, turn=triples, color=colors)
def test_rows_put_the_mesh_where_v_rep_had_it(tmp_path_factory, meshes, name, position, turn, color):
    x, y, z = position
    assume(z > -0.05)
    row = f"{color} {name}.obj {x - 0.5} {y} {z} {turn[0]} {turn[1]} {turn[2]}\n"
    (item,) = scene_of(tmp_path_factory.getbasetemp(), row, meshes).objects
    (ca, cb, cc), (sa, sb, sc) = np.cos(turn), np.sin(turn)
    Rx = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    Ry = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    Rz = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    mesh = published_mesh(name)
    in_frame = (mesh.vertices - bounds_center(mesh)) @ published_frame(name)
    expected = in_frame @ (Rx @ Ry @ Rz).T + position
    distances, _ = KDTree(corners(item)).query(expected)
    assert distances.max() < 1e-6
    assert item.color == PALETTE[color]


def test_a_mesh_that_was_saved_turned_still_lands_in_its_own_frame(tmp_path):
    slab = published_mesh("hexagonal_slab")
    turned = Mesh(slab.vertices @ rotvec_to_matrix((0.2, 0.3, -0.2)).T + (0.5, 0, 0), slab.triangles)
    for name, mesh in (("straight.obj", slab), ("turned.obj", turned)):
        write_obj(tmp_path / name, mesh)
    rows = [f"block {name} -0.5 0.1 0.03 0.4 0.5 0.6\n" for name in ("straight.obj", "turned.obj")]
    straight, other = scene_of(tmp_path, "".join(rows), tmp_path).objects
    np.testing.assert_allclose(corners(other), corners(straight), atol=1e-7)


def test_the_two_public_formats_agree(tmp_path, meshes):
    pose = "-0.52 0.03 0.025 0.1 0.2 0.3"
    (named,) = scene_of(tmp_path, f"red arch.obj {pose}\n\n", meshes).objects
    (vpg,) = scene_of(tmp_path, f"\nobjects/blocks/arch.obj 1.0 0.3412 0.349 {pose}\r\n", meshes).objects
    assert vpg.color == named.color == PALETTE["red"]
    np.testing.assert_allclose(vpg.T_base_object, named.T_base_object)


def test_obstacles_never_have_the_colour_of_a_goal(tmp_path, meshes):
    rows = "".join(f"block cube.obj {-0.7 + 0.03 * i} 0 0.025 0 0 0\n" for i in range(12))
    scene = scene_of(tmp_path, "blue cube.obj -0.5 0.1 0.025 0 0 0\n" + rows, meshes)
    assert not scene.drop
    assert [item.color for item in scene.objects].count(PALETTE["blue"]) == 1
    assert len({item.name for item in scene.objects}) == 13


def test_parked_objects_are_left_out(tmp_path, meshes):
    here, beside, below = "-0.5 0 0.025", "-0.5 1.2 0.025", "-0.5 0 -0.6"
    rows = [f"block cube.obj {place} 0 0 0\n" for place in (beside, here, below)]
    assert len(scene_of(tmp_path, "".join(rows), meshes).objects) == 1
    with pytest.raises(ConfigError, match="every object is parked"):
        scene_of(tmp_path, rows[0], meshes)


def test_frames_toml_stands_above_the_rule(tmp_path):
    write_obj(tmp_path / "p.obj", block("plank").mesh)
    (tmp_path / "frames.toml").write_text('["p.obj"]\nx = [1, 0, 0]\ny = [0, 1, 0]\n', encoding="utf-8")
    (item,) = scene_of(tmp_path, "red p.obj -0.5 0 0.0125 0 0 0\n", tmp_path).objects
    np.testing.assert_allclose(item.T_base_object[:3, :3], np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = [1, 0", "not a TOML file"),
        ("x = " + 5000 * "1", "not a TOML file"),
        ("x = " + 3000 * "[", "nested too deeply"),
        ('["q.obj"]\nx = [1, 0, 0]\ny = [0, 1, 0]\n', "no mesh 'q.obj'"),
        ('["p.obj"]\nx = [true, 0, 0]\ny = [0, 1, 0]\n', "p.obj, x, 0"),
        ('["p.obj"]\nx = [1, 0, 0]\n', "p.obj, y"),
        ('["p.obj"]\nx = [1, 0, 0]\ny = [1, 1, 0]\n', "p.obj: x and y must be unit vectors"),
    ],
)
def test_a_malformed_frames_toml_is_refused(tmp_path, text, message):
    write_obj(tmp_path / "p.obj", block("plank").mesh)
    (tmp_path / "frames.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        scene_of(tmp_path, "red p.obj -0.5 0 0.0125 0 0 0\n", tmp_path)


TOML = """
name = "mesh"
center = [0.1, 0.0]
yaw = 1.5
[[object]]
name = "it"
mesh = "cube.obj"
color = [1, 2, 3]
position = [0.05, 0.0, 0.0125]
rotation = [0.1, 0.2, 0.3]
"""
GOOD_ROW = "red cube.obj -0.5 0 0.025 0 0 0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no objects"),
        ("red cube.obj -0.5 0 0.025\n", "line 1: 5 fields"),
        (GOOD_ROW + "\nred cube.obj -0.5 0 0.025 0 0\n", "line 3: 7 fields where the rows above have 8"),
        (GOOD_ROW + "mauve cube.obj -0.5 0 0.025 0 0 0\n", "line 2: 'mauve' is neither 'block' nor a colour.*pink"),
        (GOOD_ROW + "red cube.obj -0.5 0 high 0 0 0\n", "line 2: z is 'high'"),
        (GOOD_ROW + "red cube.obj -0.5 0 0 0 inf 0\n", "line 2: beta is 'inf'"),
        (GOOD_ROW + "red cube.step -0.5 0 0 0 0 0\n", "line 2: 'cube.step' is not the name of a mesh file"),
        (GOOD_ROW + "red none.obj -0.5 0 0 0 0 0\n", "line 2: there is no none.obj in"),
        (GOOD_ROW + "red cube.obj -0.5 0 0_1 0 0 0\n", "line 2: z is '0_1', which is no number"),
        (GOOD_ROW + "red cube.obj -0.5 0 \u0661 0 0 0\n", "line 2: z is '\u0661', which is no number"),
        (GOOD_ROW + "red cube.obj -0.5 0 0 1e308 0 0\n", "line 2: alpha is '1e308'; it must lie within 1000"),
        (GOOD_ROW + f"red {5000 * 'a'}.obj -0.5 0 0 0 0 0\n", "line 2: there is no aaa"),
        ("cube.obj 0.1 0.2 1.5 -0.5 0 0 0 0 0\n", "line 1: the colour 0.1 0.2 1.5 is outside 0..1"),
        ("cube.obj 0.1 blue 0.5 -0.5 0 0 0 0 0\n", "line 1: g is 'blue'"),
    ],
)
def test_a_malformed_row_is_refused_with_file_line_and_reason(tmp_path, meshes, text, message):
    with pytest.raises(ConfigError, match=message) as refusal:
        scene_of(tmp_path, text, meshes)
    assert "scene.txt" in str(refusal.value)


def test_rows_without_their_meshes_are_refused_with_the_option_to_give(tmp_path):
    with pytest.raises(ConfigError, match="--meshes DIR"):
        scene_of(tmp_path, GOOD_ROW)


@given(text=st.text(alphabet="red cube.obj 0123456789-.e\n", max_size=200))
def test_garbage_rows_are_never_more_than_a_config_error(tmp_path_factory, meshes, text):
    with suppress(ConfigError):
        scene_of(tmp_path_factory.getbasetemp(), text, meshes)


def test_rows_may_come_from_windows_and_carry_comments(tmp_path, meshes):
    pose = "-0.52 0.03 0.025 0.1 0.2 0.3"
    text = f"\ufeff# colour, mesh, pose\nred ARCH.OBJ {pose}\n  # red cube.obj\nred objects\\blocks\\arch.obj {pose}\n"
    first, second = scene_of(tmp_path, text, meshes).objects
    assert (first.shape.name, first.name) == ("arch", "red arch line 2")
    np.testing.assert_array_equal(first.T_base_object, second.T_base_object)


def test_toml_files_may_begin_with_a_byte_order_mark_and_end_in_capitals(tmp_path):
    write_obj(tmp_path / "p.obj", block("plank").mesh)
    (tmp_path / "frames.toml").write_text('\ufeff["p.obj"]\nx = [1, 0, 0]\ny = [0, 1, 0]\n', encoding="utf-8")
    (item,) = scene_of(tmp_path, "red p.obj -0.5 0 0.0125 0 0 0\n", tmp_path).objects
    np.testing.assert_allclose(item.T_base_object[:3, :3], np.eye(3), atol=1e-9)
    write_obj(tmp_path / "cube.obj", block("cube").mesh)
    assert scene_of(tmp_path, "\ufeff" + TOML, tmp_path, suffix=".TOML").name == "mesh"


def test_objects_that_name_the_same_mesh_share_its_shape(tmp_path, meshes):
    entry = TOML[TOML.index("[[") :]
    first, second = scene_of(tmp_path, TOML + entry.replace('"it"', '"other"'), meshes, suffix=".toml").objects
    assert first.shape is second.shape


INTRUDERS = ["1e400", "nan", "-1e300", "9" * 5000, "\0", "\u0663", "0_1", "#", "[[[", "true", "a" * 5000 + ".obj", "="]


@given(data=st.data())
def test_mutated_rows_are_never_more_than_a_config_error(tmp_path_factory, meshes, data):
    rows = data.draw(st.sampled_from([2 * GOOD_ROW, 2 * "cube.obj 0.1 0.2 0.5 -0.5 0 0 0 0 0\n"]))
    with suppress(ConfigError):
        scene_of(tmp_path_factory.getbasetemp(), mutated(data, rows, INTRUDERS), meshes)


@given(data=st.data())
def test_a_mutated_toml_scene_is_never_more_than_a_config_error(tmp_path_factory, meshes, data):
    with suppress(ConfigError):
        scene_of(tmp_path_factory.getbasetemp(), mutated(data, TOML, INTRUDERS), meshes, suffix=".toml")


@given(data=st.data())
def test_a_mutated_frames_toml_is_never_more_than_a_config_error(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    write_obj(folder / "p.obj", block("plank").mesh)
    text = mutated(data, '["p.obj"]\nx = [1, 0, 0]\ny = [0, 1, 0]\n', INTRUDERS)
    (folder / "frames.toml").write_text(text, encoding="utf-8")
    with suppress(ConfigError):
        scene_of(folder, "red p.obj -0.5 0 0.0125 0 0 0\n", folder)


@given(text=st.text(max_size=60))
def test_garbage_toml_is_never_more_than_a_config_error(tmp_path_factory, text):
    with pytest.raises(ConfigError):
        scene_of(tmp_path_factory.getbasetemp(), text, suffix=".toml")


entries = st.lists(st.tuples(st.sampled_from(BLOCK_NAMES), colors, positions, triples), min_size=1, max_size=6)


@settings(max_examples=40)
@given(items=entries, drop=st.booleans())
def test_a_toml_scene_says_what_was_written(tmp_path_factory, items, drop):
    lines = ['name = "made"', f"drop = {str(drop).lower()}"]
    for i, (shape, color, position, rotation) in enumerate(items):
        lines += ["[[object]]", f'name = "{i}"', f'shape = "{shape}"', f'color = "{color}"']
        lines += [f"position = {list(position)}", f"rotation = {list(rotation)}"]
    scene = scene_of(tmp_path_factory.getbasetemp(), "\n".join(lines), suffix=".toml")
    assert (scene.name, scene.drop, len(scene.objects)) == ("made", drop, len(items))
    for item, (shape, color, position, rotation) in zip(scene.objects, items, strict=True):
        assert (item.shape.name, item.color) == (shape, PALETTE[color])
        R = item.T_base_object[:3, :3]
        np.testing.assert_allclose(R, rotvec_to_matrix(rotation), atol=1e-9)
        centre = transform_points(item.T_base_object, bounds_center(item.shape.mesh))
        np.testing.assert_allclose(centre, position, atol=1e-9)


def test_a_toml_scene_may_name_meshes_and_be_turned_as_a_whole(tmp_path, meshes):
    text = """
    name = "turned"
    center = [0.1, 0.0]
    yaw = 1.5707963267948966
    [[object]]
    name = "it"
    mesh = "plank.obj"
    color = [1, 2, 3]
    position = [0.05, 0.0, 0.0125]
    """
    (item,) = scene_of(tmp_path, text, meshes, suffix=".toml").objects
    low, high = corners(item).min(axis=0), corners(item).max(axis=0)
    np.testing.assert_allclose(low, (0.075, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(high, (0.125, 0.1, 0.025), atol=1e-9)
    assert item.color == (1, 2, 3)


OBJECT = {"name": '"a"', "shape": '"cube"', "color": '"red"', "position": "[0, 0, 0.025]"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wieght": "1"}, "object 1, wieght: Extra inputs"),
        ({"position": "[0, 0]"}, "object 1, position, 2: Field required"),
        ({"position": "[0, 0, nan]"}, "object 1, position, 2: Input should be a finite"),
        ({"position": '["0", 0, 0]'}, "object 1, position, 0: Input should be a valid number"),
        ({"position": "[true, 0, 0]"}, "object 1, position, 0: Input should be a valid number"),
        ({"position": f"[0, 0, 1{5000 * '0'}]"}, "not a TOML file"),
        ({"rotation": "[1e200, 1e200, 0]"}, "object 1, rotation, 0: Input should be less"),
        ({"rotation": 3000 * "["}, "nested too deeply"),
        ({"shape": None, "mesh": f'"{5000 * "m"}.obj"'}, "object 'a': no mesh 'mmm"),
        ({"color": '"mauve"'}, "object 1: color 'mauve' is no colour; there are blue"),
        ({"color": "[1, 2, 300]"}, "object 1, color.*255"),
        ({"shape": '"ball"'}, "object 1: shape 'ball' is no block; there are triangular_prism"),
        ({"mesh": '"m.obj"'}, "object 1: give either shape"),
        ({"shape": None, "mesh": '"m.obj"'}, "object 'a': no mesh 'm.obj' in .*--meshes"),
    ],
)
def test_a_mistake_in_a_toml_scene_is_refused_with_object_and_key(tmp_path, change, message):
    pairs = {key: value for key, value in (OBJECT | change).items() if value is not None}
    text = 'name = "s"\n[[object]]\n' + "\n".join(f"{key} = {value}" for key, value in pairs.items())
    with pytest.raises(ConfigError, match=message) as refusal:
        scene_of(tmp_path, text, suffix=".toml")
    assert "scene.toml" in str(refusal.value)


def test_every_mistake_is_reported_at_once_and_names_are_unique(tmp_path):
    entry = "[[object]]\n" + "\n".join(f"{key} = {value}" for key, value in OBJECT.items()) + "\n"
    with pytest.raises(ConfigError, match="share the name 'a'"):
        scene_of(tmp_path, 'name = "s"\n' + entry + entry, suffix=".toml")
    with pytest.raises(ConfigError, match="2 mistake"):
        scene_of(tmp_path, 'name = ""\n', suffix=".toml")
    with pytest.raises(ConfigError, match="no such file"):
        read_scene(tmp_path / "none.toml", None)


def test_colours_are_the_words_of_css_too(tmp_path):
    text = 'name = "s"\n' + "".join(
        f'[[object]]\nname = "{word}"\nshape = "cube"\ncolor = "{word}"\nposition = [{x}, 0, 0.025]\n'
        for x, word in ((0.0, "Violet"), (0.1, "red"))
    )
    (tmp_path / "scene.toml").write_text(text)
    violet, red = read_scene(tmp_path / "scene.toml", None).objects
    assert violet.color == (238, 130, 238)
    assert red.color == PALETTE["red"]
