import numpy as np
import pytest
from scipy.spatial import ConvexHull

from robotcell.config import load_config
from robotcell.errors import ConfigError, ConnectionLost
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import transform_points
from sim_twin.world.bodies import wake
from tests.sim_twin.cells import finish, joints_at, open_twin, tool_down, with_block


def record(seed):
    """Everything that moves, after a fixed series of commands."""
    cell, world = open_twin(objects=6, seed=seed)
    with cell.arm, cell.gripper:
        target = world.objects()[0][1][:3, 3]
        cell.arm.start_joints(joints_at(tool_down(target[0], target[1], 0.12)), 1.5, 1.4)
        finish(cell)
        cell.arm.start_linear(tool_down(target[0], target[1], 0.02), 0.1, 1.2)
        finish(cell, guard_n=30.0)
        cell.gripper.start_width(0.0, 40.0)
        cell.clock.sleep(0.5)
        state = cell.arm.state()
        return [state.q, state.wrench, cell.gripper.state().width_m, *(T for _, T in world.objects())]


def test_the_same_seed_and_commands_give_the_same_world_to_the_last_bit():
    first, second = record(4), record(4)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_dropped_objects_rest_in_the_workspace():
    for seed in (0, 1):
        cell, world = open_twin(objects=10, seed=seed)
        area = cell.config.workspace
        with cell.arm:
            before = [T for _, T in world.objects()]
            assert len(before) == 10
            for (item, T), other in zip(world.objects(), range(10), strict=True):
                assert area.x[0] <= T[0, 3] <= area.x[1]
                assert area.y[0] <= T[1, 3] <= area.y[1]
                lowest = transform_points(T, item.shape.mesh.vertices)[:, 2].min()
                assert lowest > -0.002
                assert not world.in_bin(other)
            cell.clock.sleep(0.5)
            moved = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, (_, b) in zip(before, world.objects(), strict=True)]
            assert max(moved) < 0.005


def test_a_block_rests_on_the_table_at_its_true_height():
    for name in ("cube", "arch", "plank"):
        cell, world = with_block(name, -0.5, 0.1)
        with cell.arm:
            item, T = world.objects()[0]
            points = transform_points(T, item.shape.mesh.vertices)
            assert points[:, 2].min() == pytest.approx(0.0, abs=3e-4)


def test_the_arch_is_hollow():
    cell, world = with_block("arch", -0.5, 0.0)
    with cell.arm:
        simulation = world.simulation
        through = simulation.engine.rayTest((-0.5, -0.2, 0.01), (-0.5, 0.2, 0.01), physicsClientId=simulation.client)
        solid = simulation.engine.rayTest((-0.5, -0.2, 0.045), (-0.5, 0.2, 0.045), physicsClientId=simulation.client)
        assert through[0][0] == -1
        assert solid[0][0] == simulation.bodies[0]


def test_an_object_let_go_over_the_bin_is_in_the_bin():
    (x, y), rim = load_config().bin.center, load_config().bin.wall_height_m
    cell, world = with_block("cube", x, y)
    with cell.arm:
        simulation = world.simulation
        simulation.engine.resetBasePositionAndOrientation(
            simulation.bodies[0], (x, y, rim + 0.1), (0, 0, 0, 1), physicsClientId=simulation.client
        )
        wake(simulation, simulation.bodies[0])
        assert not world.in_bin(0)
        cell.clock.sleep(0.6)
        assert world.in_bin(0)
        assert 0.02 < world.objects()[0][1][2, 3] < rim


def test_two_worlds_live_side_by_side_and_each_again():
    one, world = open_twin(objects=1, seed=1)
    two, other = open_twin(objects=1, seed=2)
    with one.arm, two.arm:
        one.clock.sleep(0.5)
        assert world.time_s == pytest.approx(0.5)
        assert other.time_s == 0.0
        start = world.objects()[0][1]
    with pytest.raises(ConnectionLost, match="not connected"):
        one.clock.sleep(0.1)
    with one.gripper:
        assert np.array_equal(world.objects()[0][1], start)
        one.clock.sleep(0.1)
        assert one.clock.now() == pytest.approx(0.6, abs=0.005)


def test_the_engine_ends_with_the_last_device():
    cell, world = open_twin(objects=1)
    cell.arm.connect()
    cell.gripper.connect()
    cell.arm.close()
    cell.clock.sleep(0.1)
    cell.gripper.close()
    with pytest.raises(ConnectionLost):
        world.step()


def test_home_is_out_of_the_cameras_view_and_clear_of_everything():
    cell, world = open_twin(objects=1)
    config = cell.config
    area, top = config.workspace, config.table.height_m
    corners = [(x, y, z) for x in area.x for y in area.y for z in (top, top + 0.15)]
    planes = ConvexHull([config.camera.position, *corners]).equations
    with cell.arm, cell.gripper:
        for visual, T in zip(world.visuals(), world.visual_poses(), strict=True):
            if visual.kind in ("arm", "gripper"):
                points = transform_points(T, visual.vertices)
                outside = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
                assert outside.min() > 0.05
        assert world.contact().robot_force.tolist() == [0, 0, 0]
        T_base_tcp = ur5e.forward(config.motion.home_q) @ rg2.T_FLANGE_TCP
        assert T_base_tcp[2, 2] < -0.99999
        assert joints_at(tool_down(*config.bin.center, top + 0.25)) is not None


def test_surfaces_are_closed_and_wound_outwards():
    cell, world = open_twin(objects=4)
    with cell.arm:
        for visual in world.visuals():
            a, b, c = (visual.vertices[visual.triangles[:, i]].astype(np.float64) for i in range(3))
            volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
            assert volume > 0
            assert np.abs(np.cross(b - a, c - a).sum(axis=0)).max() < 1e-6
        kinds = {visual.kind for visual in world.visuals()}
        assert kinds == {"table", "bin", "post", "arm", "gripper", "object"}
        assert world.visual_poses().shape == (len(world.visuals()), 4, 4)


def test_an_object_that_rolls_off_the_table_does_not_hold_up_the_scene():
    # With this seed a cylinder leaves the table while the others settle.
    cell, world = open_twin(objects=30, seed=4)
    area = cell.config.workspace
    with cell.arm:
        for _, T in world.objects():
            assert area.x[0] <= T[0, 3] <= area.x[1]
            assert area.y[0] <= T[1, 3] <= area.y[1]
            assert T[2, 3] > 0


@pytest.mark.parametrize("position", ["[5.0, 5.0, 0.025]", "[0.0, 0.0, -0.5]"])
def test_a_scene_off_the_table_is_refused(tmp_path, position):
    path = tmp_path / "far.toml"
    path.write_text(
        f'name = "far"\ndrop = false\n[[object]]\nname = "lost cube"\nshape = "cube"\ncolor = "red"\n'
        f"position = {position}\n"
    )
    cell, _ = open_twin(scene=str(path))
    with pytest.raises(ConfigError, match="'lost cube' fell off the table"), cell.arm:
        pass
