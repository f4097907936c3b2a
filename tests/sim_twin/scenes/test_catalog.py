import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from robotcell.config import Workspace, load_config
from robotcell.errors import ConfigError
from robotcell.geometry.rg2 import FINGER_BREADTH_M, FINGER_THICKNESS_M
from robotcell.geometry.transforms import transform_points
from robotcell.motion.rotations import ROTATIONS
from robotcell.perception.colors import PALETTE
from sim_twin.devices.arm import TwinArm
from sim_twin.devices.gripper import TwinGripper
from sim_twin.options import TwinOptions
from sim_twin.scenes.catalog import make_scene, scene_names
from sim_twin.world.world import World

WORKSPACE = Workspace()
CHALLENGING = [f"challenging-{i:02d}" for i in range(1, 11)]

# A raster for the test of finger room; the fingertips are to reach this far below the surface they straddle.
CELL_M = 0.001
GRIP_M = 0.010
TIP_CLEARANCE_M = 0.003
TOUCH_M = 0.0005


def made(name, count=10, seed=0, workspace=WORKSPACE, table=0.0, meshes=None):
    return make_scene(name, count, seed, workspace, table, meshes)


def corners(item):
    return transform_points(item.T_base_object, item.shape.mesh.vertices)


def top_view(objects, workspace):
    """Height of the top surface (rows, cols) [m] and the number of the object that it belongs to, -1 for none."""
    xs = np.arange(workspace.x[0] + CELL_M / 2, workspace.x[1], CELL_M)
    ys = np.arange(workspace.y[0] + CELL_M / 2, workspace.y[1], CELL_M)
    height, owner = np.zeros((len(ys), len(xs))), np.full((len(ys), len(xs)), -1)
    for number, item in enumerate(objects):
        for a, b, c in corners(item)[item.shape.mesh.triangles]:
            (cols, rows) = (
                slice(*np.searchsorted(grid, [min(a[i], b[i], c[i]), max(a[i], b[i], c[i])]))
                for i, grid in enumerate((xs, ys))
            )
            x, y = np.meshgrid(xs[cols], ys[rows])
            area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            if abs(area) < 1e-10:
                continue
            beta = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
            gamma = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
            z = a[2] + beta * (b[2] - a[2]) + gamma * (c[2] - a[2])
            seen = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1) & (z > height[rows, cols])
            height[rows, cols][seen] = z[seen]
            owner[rows, cols][seen] = number
    return height, owner


def free_grasps(height, goal, opening_m):
    """How many pairs of a goal cell and one of the eight jaw angles leave both fingers free of material."""
    rows, cols = np.nonzero(goal)
    tip = np.maximum(height[rows, cols] - GRIP_M, TIP_CLEARANCE_M)
    along = np.arange(opening_m / 2, opening_m / 2 + FINGER_THICKNESS_M, CELL_M)
    across = np.arange(-FINGER_BREADTH_M / 2, FINGER_BREADTH_M / 2, CELL_M)
    u, v = (grid.ravel() for grid in np.meshgrid(along, across))
    count = 0
    for k in range(ROTATIONS // 2):
        c, s = np.cos(2 * np.pi * k / ROTATIONS), np.sin(2 * np.pi * k / ROTATIONS)
        free = np.ones(len(rows), bool)
        for side in (1, -1):
            d_col = np.round((side * u * c - v * s) / CELL_M).astype(int)
            d_row = np.round((side * u * s + v * c) / CELL_M).astype(int)
            free &= height[rows[:, None] + d_row, cols[:, None] + d_col].max(axis=1) <= tip
        count += int(free.sum())
    return count


def goal_of(objects):
    (goal,) = (i for i, item in enumerate(objects) if item.color == PALETTE["red"])
    return goal


def overlap(item, other, lift=0.0):
    """How deep [m] two objects are in each other: twice the radius of the largest ball in both; negative when apart."""
    deepest = -np.inf
    for part in item.shape.parts:
        for other_part in other.shape.parts:
            raised = transform_points(item.T_base_object, part.vertices) + np.array([0, 0, lift])
            planes = np.vstack(
                [
                    ConvexHull(raised).equations,
                    ConvexHull(transform_points(other.T_base_object, other_part.vertices)).equations,
                ]
            )
            result = linprog(
                [0, 0, 0, -1],
                A_ub=np.column_stack([planes[:, :3], np.ones(len(planes))]),
                b_ub=-planes[:, 3],
                bounds=[(None, None)] * 4,
            )
            deepest = max(deepest, 2 * result.x[3])
    return deepest


def radius(item):
    return np.linalg.norm(item.shape.mesh.vertices, axis=1).max()


def test_ten_objects_show_each_colour_once_and_thirty_three_times():
    for count, times in ((10, 1), (30, 3)):
        colors = [item.color for item in made("random", count).objects]
        assert {colors.count(color) for color in PALETTE.values()} == {times}


def test_a_random_goal_is_the_one_red_object_anywhere_in_the_heap():
    scenes = [made("random-goal", 30, seed) for seed in range(8)]
    for scene in scenes:
        colors = [item.color for item in scene.objects]
        assert colors.count(PALETTE["red"]) == 1
        assert {3, 4} >= {colors.count(color) for name, color in PALETTE.items() if name != "red"}
    assert len({goal_of(scene.objects) for scene in scenes}) > 4
    assert [item.color for item in made("random-goal", 1).objects] == [PALETTE["red"]]


@pytest.mark.parametrize("seed", range(3))
def test_a_drop_starts_over_the_middle_of_the_workspace_and_clear_of_itself(seed):
    scene = made("random", 30, seed, table=0.05)
    assert scene.drop
    assert len({item.name for item in scene.objects}) == 30
    places = np.array([item.T_base_object[:3, 3] for item in scene.objects])
    assert np.abs(places[:, :2] - (-0.5, 0.0)).max() <= 0.112
    assert min(corners(item)[:, 2].min() for item in scene.objects) > 0.05
    for i, item in enumerate(scene.objects):
        for j in range(i):
            assert np.linalg.norm(places[i] - places[j]) > radius(item) + radius(scene.objects[j])


def test_the_same_seed_makes_the_same_drop_and_another_seed_another():
    first, again, other = (made("random", 5, seed) for seed in (1, 1, 2))
    for a, b in zip(first.objects, again.objects, strict=True):
        assert (a.name, a.color) == (b.name, b.color)
        np.testing.assert_array_equal(a.T_base_object, b.T_base_object)
    assert [item.name for item in first.objects] != [item.name for item in other.objects]


def test_there_are_ten_challenging_scenes():
    assert scene_names() == ["random", "random-goal", "novel", *CHALLENGING]


@pytest.mark.parametrize("name", CHALLENGING)
def test_no_fingers_fit_around_the_goal_of_a_challenging_scene(name):
    objects = made(name).objects
    height, owner = top_view(objects, WORKSPACE)
    goal = owner == goal_of(objects)
    # At least 8 cm2 of the goal are to be seen from above.
    assert goal.sum() * CELL_M**2 > 8e-4
    for opening_m in (0.060, 0.070, 0.080):
        assert free_grasps(height, goal, opening_m) == 0


@pytest.mark.parametrize("name", CHALLENGING)
def test_the_goal_of_a_challenging_scene_could_be_grasped_if_it_stood_alone(name):
    objects = made(name).objects
    alone = (objects[goal_of(objects)],)
    height, owner = top_view(alone, WORKSPACE)
    assert free_grasps(height, owner == 0, 0.080) > 0


@pytest.mark.parametrize("name", CHALLENGING)
def test_a_challenging_scene_stands_without_interpenetration(name):
    objects = made(name).objects
    for i, item in enumerate(objects):
        others = objects[:i] + objects[i + 1 :]
        near = [o for o in others if np.linalg.norm((o.T_base_object - item.T_base_object)[:3, 3]) < 0.13]
        assert all(overlap(item, other) < 0.0001 for other in near)
        lowest = corners(item)[:, 2].min()
        assert lowest > -0.0001
        assert lowest < TOUCH_M or any(overlap(item, other, lift=-2 * TOUCH_M) > 0 for other in near)


@pytest.mark.parametrize("name", CHALLENGING)
def test_a_challenging_scene_stays_as_it_was_placed(name):
    config = load_config(overrides={"backend.options.scene": name})
    world = World(config, TwinOptions(scene=name))
    with TwinArm(world), TwinGripper(world):
        world.step(240)
        moved = [np.linalg.norm((T - item.T_base_object)[:3, 3]) for item, T in world.objects()]
    assert max(moved) < 0.002


def test_a_scene_moves_with_the_workspace_and_the_table():
    moved = Workspace(x=(0.2, 0.6), y=(-0.5, -0.1))
    for before, after in zip(
        made(CHALLENGING[0]).objects, made(CHALLENGING[0], workspace=moved, table=0.1).objects, strict=True
    ):
        shift = after.T_base_object - before.T_base_object
        np.testing.assert_allclose(shift[:3, 3], (0.9, -0.3, 0.1), atol=1e-12)


def test_novel_objects_drop_in_different_colours():
    scene = made("novel", 3)
    assert scene.drop
    assert len({item.shape.name for item in scene.objects}) == 3
    assert {item.color for item in scene.objects} <= set(PALETTE.values())


def test_a_path_names_a_scene_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'name = "mine"\n[[object]]\nname = "a"\nshape = "cube"\ncolor = "red"\nposition = [0, 0, 0.025]\n',
        encoding="utf-8",
    )
    scene = made(str(path), table=0.2)
    assert scene.name == "mine"
    np.testing.assert_allclose(scene.objects[0].T_base_object[:3, 3], (-0.5, 0, 0.225), atol=1e-9)


def test_an_unknown_scene_is_refused_with_the_list():
    with pytest.raises(ConfigError, match=r"'chaos'; there are random, random-goal, novel, chall.*path of a file"):
        made("chaos")


def test_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(ConfigError, match="no scene or scene file"):
        made(5000 * "a")


def test_a_folder_of_meshes_that_a_scene_does_not_use_is_refused(tmp_path):
    for name in ("random", CHALLENGING[0]):
        with pytest.raises(ConfigError, match=f"'{name}'.*--meshes"):
            made(name, meshes=tmp_path)


def test_a_folder_of_meshes_that_is_none_is_refused(tmp_path):
    path = tmp_path / "scene.txt"
    path.write_text("red a.obj -0.5 0 0 0 0 0", encoding="utf-8")
    for folder in (path, tmp_path / "none"):
        with pytest.raises(ConfigError, match="no such folder; --meshes"):
            made(str(path), meshes=folder)


def test_a_scene_without_objects_is_refused():
    with pytest.raises(ConfigError, match="at least one object"):
        made("random", 0)
