import numpy as np
import pytest

from robotcell.errors import ConfigError
from sim_twin.scenes.meshes import Mesh, mesh_centroid
from sim_twin.scenes.novel import is_graspable, novel_shape, novel_shapes, resting_poses
from sim_twin.scenes.shapes import block, shape_of


def test_a_plank_rests_on_each_of_its_six_faces():
    poses = list(resting_poses(block("plank")))
    found = sorted((round(1000 * pose.height_m), round(1000 * pose.width_m)) for pose in poses)
    assert found == [(25, 50), (25, 50), (50, 25), (50, 25), (100, 25), (100, 25)]


def test_a_prism_does_not_rest_on_its_ridge():
    assert all(pose.down[2] < 0.99 for pose in resting_poses(block("triangular_prism")))


def test_drawn_objects_fit_the_gripper_however_they_lie_and_differ():
    shapes = novel_shapes(4, np.random.default_rng(1))
    assert len({shape.name for shape in shapes}) == 4
    for shape in shapes:
        assert np.linalg.norm(mesh_centroid(shape.mesh)) < 1e-6
        for pose in resting_poses(shape):
            assert pose.width_m <= 0.080
            assert pose.height_m >= 0.015


def test_the_same_seed_draws_the_same_objects():
    names = [[s.name for s in novel_shapes(2, np.random.default_rng(3))] for _ in range(2)]
    assert names[0] == names[1]


def test_an_object_in_two_pieces_is_not_graspable(monkeypatch):
    cube = block("cube").mesh
    whole, broken = (
        shape_of("pair", (cube, Mesh(cube.vertices + np.array([gap, 0, 0]), cube.triangles))) for gap in (0.02, 0.06)
    )
    for shape, expected in ((whole, True), (broken, False)):
        monkeypatch.setattr("sim_twin.scenes.novel.novel_shape", lambda _, shape=shape: shape)
        assert is_graspable.__wrapped__(0) is expected


def test_walls_around_nothing_are_not_graspable(monkeypatch):
    cube = block("cube").mesh
    thin = tuple(
        Mesh(cube.vertices * np.roll([1, 1, 0.02], axis) + 0.025 * side * np.roll([0, 0, 1], axis), cube.triangles)
        for axis in range(3)
        for side in (-1, 1)
    )
    shape = shape_of("box without a core", thin)
    monkeypatch.setattr("sim_twin.scenes.novel.novel_shape", lambda _: shape)
    assert not is_graspable.__wrapped__(0)


@pytest.mark.parametrize("number", [552, 703])
def test_files_of_slivers_are_not_graspable(number):
    assert not is_graspable(number)


def test_a_file_without_a_shape_is_not_graspable():
    # Its vertices are NaN in the package.
    assert not is_graspable(168)


@pytest.mark.parametrize("number", [-1, 900, 999])
def test_the_objects_kept_for_evaluation_are_refused(number):
    with pytest.raises(ConfigError, match="outside 0 to 899"):
        novel_shape(number)


def test_more_objects_than_there_are_is_refused(monkeypatch):
    monkeypatch.setattr("sim_twin.scenes.novel.is_graspable", lambda number: number == 0)
    with pytest.raises(ConfigError, match="1 graspable novel objects; 5"):
        novel_shapes(5, np.random.default_rng(0))
