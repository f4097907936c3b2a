"""The gripper on slides: what attempts come to, and that they can be undone."""

import math

import numpy as np
import pytest

from robotcell.config import load_config
from robotcell.geometry.transforms import make_transform
from sim_twin.devices.backend import TwinOptions
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import block
from sim_twin.world.sliding_gripper import Ending, RigWorld
from sim_twin.world.world import Friction

X, Y = -0.5, 0.02


def cube(name, x, y):
    return SceneObject(name, block("cube"), (200, 30, 30), make_transform(np.eye(3), (x, y, 0.0255)))


@pytest.fixture
def rig():
    """Two cubes, 20 mm apart."""
    scene = Scene("two cubes", (cube("one", X, Y), cube("two", X + 0.07, Y)), drop=False)
    world = RigWorld(load_config(), TwinOptions(), scene, Friction())
    try:
        world.connect()
        yield world
    finally:
        world.close()


def grasp(rig, x, y, theta):
    return rig.grasp(x, y, theta, near_z=0.06, tcp_z=0.010)


def positions(rig):
    return np.array([T[:3, 3] for _, T in rig.objects()])


def test_a_block_between_the_fingers_is_held(rig):
    attempt = grasp(rig, X, Y, math.pi / 2)
    assert attempt.ending is Ending.HELD
    assert attempt.held == (0,)
    assert positions(rig)[0, 2] > 0.08


def test_a_finger_that_lands_on_a_neighbour_ends_the_attempt(rig):
    attempt = grasp(rig, X, Y, 0.0)
    assert attempt.ending is Ending.COLLIDED
    assert not attempt.held


def test_fingers_that_close_beside_everything_are_empty(rig):
    assert grasp(rig, X, Y + 0.15, 0.0).ending is Ending.EMPTY


def test_an_attempt_can_be_undone_and_done_again_alike(rig):
    saved, before = rig.save(), positions(rig)
    first, after = grasp(rig, X, Y, math.pi / 2), positions(rig)
    rig.restore(saved)
    assert positions(rig) == pytest.approx(before, abs=1e-9)
    assert grasp(rig, X, Y, math.pi / 2) == first
    assert positions(rig) == pytest.approx(after, abs=1e-3)


def test_a_push_moves_what_it_meets_and_what_that_meets(rig):
    before = positions(rig)
    attempt = rig.push((X - 0.05, Y), 0.0, 0.10, near_z=0.07, tcp_z=0.025)
    rig.withdraw()
    moved = positions(rig) - before
    assert attempt.ending is Ending.PUSHED
    # The fingers are 20 mm thick and begin 15 mm before the first cube.
    assert moved[0, 0] == pytest.approx(0.085, abs=0.012)
    assert moved[1, 0] > 0.04
    assert np.abs(moved[:, 1:]).max() < 0.01


def test_a_push_cannot_begin_on_a_block(rig):
    assert rig.push((X, Y), 0.0, 0.10, near_z=0.07, tcp_z=0.025).ending is Ending.COLLIDED


def test_what_was_taken_is_gone_until_it_is_put_back(rig):
    saved = rig.save()
    rig.take((1,))
    assert rig.present == [0]
    assert not rig.drop_outs()
    rig.step(240)
    assert rig.objects()[1][1][0, 3] > 1
    rig.restore(saved)
    assert rig.present == [0, 1]


def test_an_object_off_the_workspace_has_dropped_out(rig):
    assert rig.drop_outs() == ()
    for _ in range(4):
        x, y, _ = positions(rig)[1]
        rig.push((x, y - 0.05), math.pi / 2, 0.10, near_z=0.07, tcp_z=0.025)
        rig.withdraw()
    assert rig.drop_outs() == (1,)
