"""The gripper on slides: what attempts come to, and that they can be undone."""

import math

import numpy as np
import pytest

from robotcell.config import load_config
from robotcell.geometry.transforms import make_transform
from robotcell.motion.executor import Ending
from sim_twin.devices.gantry import GantryGripper
from sim_twin.options import TwinOptions
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import block
from sim_twin.world.bodies import Friction

X, Y = -0.5, 0.02


def cube(name, x, y):
    return SceneObject(name, block("cube"), (200, 30, 30), make_transform(np.eye(3), (x, y, 0.0255)))


@pytest.fixture
def gripper():
    """Two cubes, 20 mm apart."""
    scene = Scene("two cubes", (cube("one", X, Y), cube("two", X + 0.07, Y)), drop=False)
    gripper = GantryGripper(load_config(), TwinOptions(), scene, Friction())
    try:
        gripper.connect()
        yield gripper
    finally:
        gripper.close()


def grasp(gripper, x, y, theta):
    return gripper.grasp(x, y, theta, near_z=0.06, tcp_z=0.010)


def positions(gripper):
    return np.array([T[:3, 3] for _, T in gripper.world.objects()])


def test_a_block_between_the_fingers_is_held(gripper):
    attempt = grasp(gripper, X, Y, math.pi / 2)
    assert attempt.ending is Ending.DONE
    assert attempt.held == (0,)
    assert positions(gripper)[0, 2] > 0.08


def test_a_finger_that_lands_on_a_neighbour_ends_the_attempt(gripper):
    attempt = grasp(gripper, X, Y, 0.0)
    assert attempt.ending is Ending.CONTACT
    assert not attempt.held


def test_fingers_that_close_beside_everything_are_empty(gripper):
    assert grasp(gripper, X, Y + 0.15, 0.0).ending is Ending.EMPTY


def test_an_attempt_can_be_undone_and_done_again_alike(gripper):
    saved, before = gripper.save(), positions(gripper)
    first, after = grasp(gripper, X, Y, math.pi / 2), positions(gripper)
    gripper.restore(saved)
    assert positions(gripper) == pytest.approx(before, abs=1e-9)
    assert grasp(gripper, X, Y, math.pi / 2) == first
    assert positions(gripper) == pytest.approx(after, abs=1e-3)


def test_a_push_moves_what_it_meets_and_what_that_meets(gripper):
    before = positions(gripper)
    attempt = gripper.push((X - 0.05, Y), 0.0, 0.10, near_z=0.07, tcp_z=0.025)
    gripper.withdraw()
    moved = positions(gripper) - before
    assert attempt.ending is Ending.DONE
    # The fingers are 20 mm thick and begin 15 mm before the first cube.
    assert moved[0, 0] == pytest.approx(0.085, abs=0.012)
    assert moved[1, 0] > 0.04
    assert np.abs(moved[:, 1:]).max() < 0.01


def test_a_push_cannot_begin_on_a_block(gripper):
    assert gripper.push((X, Y), 0.0, 0.10, near_z=0.07, tcp_z=0.025).ending is Ending.CONTACT


def test_what_was_taken_is_gone_until_it_is_put_back(gripper):
    saved = gripper.save()
    gripper.take((1,))
    assert gripper.present == [0]
    assert not gripper.drop_outs()
    gripper.world.step(240)
    assert gripper.world.objects()[1][1][0, 3] > 1
    gripper.restore(saved)
    assert gripper.present == [0, 1]


def test_an_object_off_the_workspace_has_dropped_out(gripper):
    assert gripper.drop_outs() == ()
    for _ in range(4):
        x, y, _ = positions(gripper)[1]
        gripper.push((x, y - 0.05), math.pi / 2, 0.10, near_z=0.07, tcp_z=0.025)
        gripper.withdraw()
    assert gripper.drop_outs() == (1,)
