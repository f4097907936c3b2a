import numpy as np
import pytest

from robotcell.geometry import rg2
from robotcell.geometry.transforms import invert_transform, transform_points
from sim_twin.devices.gripper import TwinGripper
from sim_twin.world import robot_model
from sim_twin.world.bodies import link_poses
from tests.sim_twin.cells import close_on, finish, go, joints_at, open_twin, tool_down, with_block


def tips(world):
    """The corners of the two finger tips' inner faces, in the flange frame: left and right, (4, 3) each."""
    poses = link_poses(world.simulation, world.joint_index((robot_model.LEFT_FINGER, robot_model.RIGHT_FINGER)))
    found = []
    for side, T, name in ((1, poses[0], "left_finger"), (-1, poses[1], "right_finger")):
        link = next(link for link in robot_model.links() if link.name == name)
        corners, _ = robot_model.part_mesh(link.parts[0])
        points = transform_points(invert_transform(world.flange()) @ T, corners)
        inner = (side * corners[:, 0]).min() + 1e-6 >= side * corners[:, 0]
        found.append(points[inner])
    return found


def test_the_tips_move_on_the_arc_of_the_linkage():
    cell, world = open_twin(objects=1)
    with cell.arm, cell.gripper:
        for width in np.linspace(rg2.MIN_WIDTH_M, rg2.MAX_WIDTH_M, 9):
            close_on(cell, float(width), 20.0)
            cell.clock.sleep(0.05)
            left, right = tips(world)
            assert left[:, 0].mean() - right[:, 0].mean() == pytest.approx(width, abs=3e-4)
            assert left[:, 0].mean() == pytest.approx(-right[:, 0].mean(), abs=3e-4)
            for tip in (left, right):
                end = rg2.CLOSED_LENGTH_M - tip[:, 2].max()
                assert end == pytest.approx(rg2.tip_retraction(float(width)), abs=3e-4)
                # Parallel to the approach axis, all the way.
                assert np.ptp(tip[:, 0]) < 1e-4
                assert np.ptp(tip[:, 1]) == pytest.approx(rg2.FINGER_BREADTH_M, abs=1e-5)


def test_the_fingers_take_the_time_of_their_speed():
    cell, _ = open_twin(objects=1)
    with cell.arm, cell.gripper:
        close_on(cell, 0.0, 40.0)
        begin = cell.clock.now()
        close_on(cell, 0.11, 40.0)
        assert cell.clock.now() - begin == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("force", [5.0, 20.0, 40.0])
def test_grips_a_block_with_the_commanded_force(force):
    cell, world = with_block("cube", -0.5, 0.0)
    with cell.arm, cell.gripper:
        cell.arm.start_joints(joints_at(tool_down(-0.5, 0.0, 0.15)), 1.5, 1.4)
        finish(cell)
        go(cell, tool_down(-0.5, 0.0, 0.015))
        close_on(cell, 0.0, force)
        state = cell.gripper.state()
        assert state.grip_detected
        # Soft tips: a firm grip reads narrower than the block.
        assert 0.044 < state.width_m < 0.0505
        assert pressure(world) == pytest.approx(force, rel=0.15)
        close_on(cell, 0.0, force)
        assert cell.gripper.state().grip_detected
        close_on(cell, 0.08, force)
        assert not cell.gripper.state().grip_detected
        assert pressure(world) == 0


def test_a_grip_that_loses_its_object_is_no_longer_one():
    cell, world = with_block("cube", -0.5, 0.0)
    with cell.arm, cell.gripper:
        cell.arm.start_joints(joints_at(tool_down(-0.5, 0.0, 0.15)), 1.5, 1.4)
        finish(cell)
        go(cell, tool_down(-0.5, 0.0, 0.015))
        close_on(cell, 0.0, 20.0)
        assert cell.gripper.state().grip_detected
        simulation = world.simulation
        simulation.engine.resetBasePositionAndOrientation(
            simulation.bodies[0], (-0.7, 0.2, 0.025), (0, 0, 0, 1), physicsClientId=simulation.client
        )
        cell.clock.sleep(1.0)
        state = cell.gripper.state()
        assert not state.grip_detected
        assert not state.busy
        assert state.width_m < 0.001


class TremblingWorld:
    """Fingers that are stopped at 48 mm and tremble there by a quarter of a millimetre in every step."""

    time_s = 0.0
    gripper_range = rg2.range_with_tips(0.0)

    def __init__(self):
        self.controllers = []
        self.steps = 0

    def attach(self, device): ...

    def detach(self, device): ...

    def add_controller(self, controller):
        self.controllers.append(controller)

    def remove_controller(self, controller):
        self.controllers.remove(controller)

    def joint_index(self, names):
        return [0, 1]

    def joint_states(self, joints):
        width = 0.048 + 0.00012 * (-1) ** self.steps
        return np.full(2, rg2.crank_angle(width)), np.full(2, 0.5 * (-1) ** self.steps)

    def drive_positions(self, *arguments): ...

    def drive_speeds(self, *arguments): ...


def test_fingers_that_tremble_on_what_they_grip_are_not_busy():
    world = TremblingWorld()
    with TwinGripper(world) as gripper:
        gripper.start_width(0.0, 40.0)
        for _ in range(60):
            world.steps += 1
            for control in world.controllers:
                control()
        assert not gripper.state().busy
        assert gripper.state().grip_detected


@pytest.mark.parametrize("name", ["cube", "plank", "half_round_slab", "arch", "cylinder"])
def test_a_block_gripped_in_the_middle_stays_in_the_grip(name):
    cell, world = with_block(name, -0.5, 0.0)
    with cell.arm, cell.gripper:
        item, T = world.objects()[0]
        height = (item.shape.mesh.vertices @ T[:3, :3].T)[:, 2].max() + T[2, 3]
        # Across y: every block of these is at most 50 mm wide there.
        z = max(height - 0.040, 0.008) - rg2.tip_retraction(0.05)
        z = max(z, 0.004)
        cell.arm.start_joints(joints_at(tool_down(-0.5, 0.0, 0.15, np.pi / 2)), 1.5, 1.4)
        finish(cell)
        go(cell, tool_down(-0.5, 0.0, z, np.pi / 2))
        close_on(cell, 0.0, 40.0)
        go(cell, tool_down(-0.5, 0.0, 0.25, np.pi / 2))
        before = world.objects()[0][1]
        cell.clock.sleep(0.5)
        after = world.objects()[0][1]
        assert cell.gripper.state().grip_detected
        assert after[2, 3] > 0.2
        assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 0.003


def pressure(world):
    """Force [N] of the left finger on what it holds."""
    simulation = world.simulation
    finger = simulation.joints[robot_model.LEFT_FINGER]
    points = simulation.engine.getContactPoints(
        bodyA=simulation.robot, linkIndexA=finger, bodyB=simulation.bodies[0], physicsClientId=simulation.client
    )
    return sum(point[9] for point in points)
