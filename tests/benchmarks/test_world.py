"""What the twin's physics costs: `pytest tests/benchmarks/test_world.py --benchmark-enable`."""

import numpy as np
import pytest

from robotcell.config import load_config
from sim_twin.devices.backend import open_twin

COUNTS = pytest.mark.parametrize("count", [10, 30])
STEPS = 120
# 0.1 s, half of what a motion may go without a kick.
STEPS_PER_KICK = 24


def twin(count):
    return open_twin(load_config(None, {"backend.options.objects": count, "backend.options.seed": 1}))


@COUNTS
def test_build(benchmark, count):
    """The world, its scene dropped and settled, the robot."""

    def build():
        cell, _ = twin(count)
        with cell.arm:
            pass

    benchmark.pedantic(build, rounds=5)


@COUNTS
def test_half_a_second_at_rest(benchmark, count):
    cell, world = twin(count)
    with cell.arm, cell.gripper:
        world.step(240)
        benchmark.pedantic(world.step, args=(STEPS,), rounds=15)


@COUNTS
def test_half_a_second_of_motion(benchmark, count):
    """The arm turns its last joint, out of reach of the objects."""
    cell, world = twin(count)
    with cell.arm, cell.gripper:
        home, sign = cell.arm.state().q, [1]

        def start():
            world.step(480)
            cell.arm.start_joints(home + np.array([0, 0, 0, 0, 0, 0.9 * sign[0]]), 1.5, 1.4)
            sign[0] = -sign[0]

        def turn():
            for _ in range(STEPS // STEPS_PER_KICK):
                cell.arm.kick()
                world.step(STEPS_PER_KICK)

        benchmark.pedantic(turn, setup=start, rounds=9)
        assert cell.arm.moving


@COUNTS
def test_a_quarter_second_awake(benchmark, count):
    """Every object awake, as while the gripper is among them."""
    cell, world = twin(count)
    with cell.arm, cell.gripper:
        simulation = world.simulation
        wake = simulation.engine.ACTIVATION_STATE_WAKE_UP

        def rouse():
            for body in simulation.bodies:
                simulation.engine.changeDynamics(body, -1, activationState=wake, physicsClientId=simulation.client)

        # Shorter than the time after which what rests is put to sleep again.
        benchmark.pedantic(world.step, args=(STEPS // 2,), setup=rouse, rounds=15)
