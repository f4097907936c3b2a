import numpy as np
import pytest

from robotcell.errors import ConnectionLost, DeviceFault
from robotcell.geometry import ur5e
from robotcell.geometry.transforms import rotation_z
from robotcell.interfaces import KICK_TIMEOUT_S, ArmMode
from sim_twin.devices.arm_limits import PROTECTIVE_FORCE_N
from sim_twin.world import robot_model
from tests.sim_twin.cells import close_on, finish, go, joints_at, open_twin, tool_down, with_block

ABOVE = (-0.60, 0.18)


@pytest.fixture
def cell():
    """The tool 5 cm above a free place of the table, fingers closed."""
    cell, _ = open_twin(objects=1)
    with cell.arm, cell.gripper:
        cell.gripper.start_width(0.0, 40.0)
        cell.arm.start_joints(joints_at(tool_down(*ABOVE, 0.05)), 1.5, 1.4)
        finish(cell)
        yield cell


def test_the_flange_is_where_the_kinematics_puts_it():
    cell, world = open_twin(objects=1)
    rng = np.random.default_rng(5)
    with cell.arm:
        simulation = world.simulation
        for q in rng.uniform(-3, 3, (20, 6)):
            for joint, angle in zip(world.joint_index([f"joint_{i}" for i in range(1, 7)]), q, strict=True):
                simulation.engine.resetJointState(simulation.robot, joint, angle, physicsClientId=simulation.client)
            np.testing.assert_allclose(world.flange(), ur5e.forward(q), atol=1e-6)


def test_follows_a_path_at_full_speed_to_a_tenth_of_a_millimetre(cell):
    start = cell.arm.state().q
    cell.arm.start_joints(start + np.array((0.8, -0.3, 0.2, 0.4, -0.6, 1.5)), 3.0, 8.0)
    finish(cell)
    T = ur5e.forward(start + np.array((0.8, -0.3, 0.2, 0.4, -0.6, 1.5)))
    assert np.linalg.norm(ur5e.forward(cell.arm.state().q)[:3, 3] - T[:3, 3]) < 1e-4


def test_a_guarded_descent_ends_on_the_table_without_a_protective_stop(cell):
    go(cell, tool_down(*ABOVE, -0.05), speed=0.10, guard_n=30.0)
    state = cell.arm.state()
    assert state.mode is ArmMode.READY
    assert abs(state.T_base_tcp[2, 3]) < 0.004
    # The table pushes up, not sideways, and less than the controller would stop at.
    assert 10 < state.wrench[2] < PROTECTIVE_FORCE_N
    assert np.linalg.norm(state.wrench[:2]) < 0.5 * state.wrench[2]
    go(cell, tool_down(*ABOVE, 0.05))
    assert np.linalg.norm(cell.arm.state().wrench) == 0


def test_a_hard_collision_stops_the_arm_until_it_is_recovered(cell):
    go(cell, tool_down(*ABOVE, -0.05), speed=0.5)
    state = cell.arm.state()
    assert state.mode is ArmMode.PROTECTIVE_STOP
    assert state.T_base_tcp[2, 3] > -0.01
    for start in (
        lambda: cell.arm.start_joints(state.q, 0.5, 1.0),
        lambda: cell.arm.start_linear(tool_down(*ABOVE, 0.05), 0.1, 0.5),
    ):
        with pytest.raises(DeviceFault, match="recover"):
            start()
    cell.clock.sleep(0.2)
    assert cell.arm.state().mode is ArmMode.PROTECTIVE_STOP
    cell.arm.recover()
    go(cell, tool_down(*ABOVE, 0.05))
    state = cell.arm.state()
    assert state.mode is ArmMode.READY
    np.testing.assert_allclose(state.T_base_tcp, tool_down(*ABOVE, 0.05), atol=1e-3)


def test_a_motion_faster_than_the_motors_allow_ends_in_a_protective_stop(cell):
    cell.arm.start_joints(np.array((-0.3, -0.6, 0.1, -1.0, -1.57, 1.3)), 1.5, 1.4)
    finish(cell)
    # Raising the stretched arm at 40 rad/s^2 takes more than the shoulder's 150 N m.
    cell.arm.start_joints(cell.arm.state().q + np.array((0, -0.8, 0, 0, 0, 0)), 3.14, 40.0)
    finish(cell)
    assert cell.arm.state().mode is ArmMode.PROTECTIVE_STOP


@pytest.mark.parametrize(
    ("start", "goal", "speed"),
    [
        pytest.param((-0.35, 0.15, 0.4), (0.35, -0.15, 0.4), 0.25, id="past the shoulder"),
        pytest.param((-0.25, 0.15, 0.4), (-0.25, -0.25, 0.4), 3.0, id="faster than a joint turns"),
        pytest.param((-0.5, 0.15, 0.4), (-2.0, 0.15, 0.4), 0.25, id="out of reach"),
    ],
)
def test_a_line_that_the_arm_cannot_follow_ends_in_a_protective_stop_on_the_line(cell, start, goal, speed):
    cell.arm.start_joints(joints_at(tool_down(*start)), 1.5, 1.4)
    finish(cell)
    cell.arm.start_linear(tool_down(*goal), speed, 50.0 if speed > 1 else 1.2)
    finish(cell)
    state = cell.arm.state()
    assert state.mode is ArmMode.PROTECTIVE_STOP
    # Somewhere on the way, and beside the line by no more than what a joint may lag behind.
    way = np.subtract(goal, start)
    length = np.linalg.norm(way)
    done = state.T_base_tcp[:3, 3] - start
    assert 0.01 < done @ way / length < 0.95 * length
    assert np.linalg.norm(np.cross(done, way / length)) < 0.02
    with pytest.raises(DeviceFault, match="recover"):
        cell.arm.start_linear(tool_down(*start), 0.1, 1.2)
    cell.arm.recover()
    go(cell, tool_down(*start), speed=0.1)
    np.testing.assert_allclose(cell.arm.state().T_base_tcp, tool_down(*start), atol=1e-3)


def test_an_arm_that_cannot_take_the_first_step_of_a_line_stops_at_once(cell):
    # The wrist is stretched: joint 5 stands at zero.
    cell.arm.start_joints(cell.arm.state().q * np.array((1, 1, 1, 1, 0, 1)), 1.5, 1.4)
    finish(cell)
    aside = cell.arm.state().T_base_tcp.copy()
    aside[:3, :3] = rotation_z(1.5) @ aside[:3, :3]
    cell.arm.start_linear(aside, 1.0, 50.0)
    finish(cell)
    assert cell.arm.state().mode is ArmMode.PROTECTIVE_STOP


def test_a_motion_that_is_kicked_no_longer_stops_on_its_path(cell):
    start = cell.arm.state().q
    cell.arm.start_joints(start + np.array((1.0, 0, 0, 0, 0, 0)), 0.5, 8.0)
    for _ in range(50):
        cell.arm.kick()
        cell.clock.sleep(0.01)
    silent_since = cell.clock.now()
    while cell.arm.moving:
        cell.clock.sleep(1 / 240)
    # 0.5 rad/s is braked in 0.025 s.
    assert KICK_TIMEOUT_S < cell.clock.now() - silent_since < KICK_TIMEOUT_S + 0.05
    assert cell.arm.state().mode is ArmMode.READY
    # It did not turn any further than at full speed until the end.
    turned = cell.arm.state().q[0] - start[0]
    assert 0.3 < turned < 0.37


def test_a_held_block_weighs_on_the_flange():
    cell, world = with_block("cube", -0.5, 0.0)
    with cell.arm, cell.gripper:
        cell.arm.start_joints(joints_at(tool_down(-0.5, 0.0, 0.15)), 1.5, 1.4)
        finish(cell)
        go(cell, tool_down(-0.5, 0.0, 0.015))
        close_on(cell, 0.0, 20.0)
        go(cell, tool_down(-0.5, 0.0, 0.15))
        forces = []
        for _ in range(24):
            cell.clock.sleep(1 / 240)
            forces.append(cell.arm.state().wrench[:3])
        shape = world.objects()[0][0].shape
        weight = shape.density_kg_m3 * shape.volume_m3 * 9.81
        np.testing.assert_allclose(np.mean(forces, axis=0), (0, 0, -weight), atol=0.05)
        assert world.objects()[0][1][2, 3] > 0.12


def test_an_arm_at_rest_that_is_pushed_away_stops_itself():
    cell, world = open_twin(objects=1)
    with cell.arm:
        simulation = world.simulation
        wrist = simulation.joints[robot_model.ARM_JOINTS[3]]
        for _ in range(24):
            engine = simulation.engine
            engine.applyExternalForce(
                simulation.robot,
                wrist,
                (0, 0, -1500),
                (0, 0, 0),
                engine.LINK_FRAME,
                physicsClientId=simulation.client,
            )
            cell.clock.sleep(1 / 240)
        assert cell.arm.state().mode is ArmMode.PROTECTIVE_STOP


@pytest.mark.parametrize("device", ["arm", "gripper"])
def test_a_device_that_was_cut_off_while_connecting_leaves_nothing_open(monkeypatch, device):
    cell, world = open_twin(objects=1)

    def cut_off(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(world, "joint_index", cut_off)
    with pytest.raises(KeyboardInterrupt):
        getattr(cell, device).connect()
    # The physics engine must be gone: the fixture for leaks looks for it.
    with pytest.raises(ConnectionLost):
        world.objects()
