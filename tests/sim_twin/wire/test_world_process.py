"""The process of the physics, driven as the other processes drive it."""

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest

from robotcell.config import load_config
from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE, GRIPPER_COMMAND, Record, poses_dtype
from sim_twin.wire.world_process import serve_world

HOME = np.array(load_config().motion.home_q)
LIMIT_S = 30.0


class Run:
    """A world in its process, and the ends of what it shares."""

    def __init__(self, **options):
        context = multiprocessing.get_context("spawn")
        self.arm, self.fingers, self.state = (Record(d) for d in (ARM_COMMAND, GRIPPER_COMMAND, CELL_STATE))
        faults, self.faults = context.Pipe(duplex=False)
        self.ready, ready = context.Pipe(duplex=False)
        config = load_config(None, {f"backend.options.{key}": value for key, value in options.items()})
        names = (self.arm.name, self.fingers.name, self.state.name)
        self.process = context.Process(target=serve_world, args=(config, *names, faults, ready))
        self.process.start()
        faults.close()
        ready.close()
        self._tick = 0

    def drive(self, q, powered=True):
        """Command the joints as a controller does, for 0.4 s, and say where they are then."""
        for _ in range(40):
            self._tick += 1
            self.arm.write(tick=self._tick, powered=powered, q=q)
            time.sleep(0.01)
        return self.state.read()["q"]

    def until(self, holds):
        """Wait for a state of which something holds."""
        end = time.monotonic() + LIMIT_S
        while not holds(self.state.read()):
            assert time.monotonic() < end
            time.sleep(0.01)
        return self.state.read()

    def close(self):
        self.process.kill()
        self.process.join()
        self.process.close()
        for thing in (self.faults, self.ready, self.arm, self.fingers, self.state):
            thing.close()


@pytest.fixture(scope="module")
def run():
    run = Run(objects=1)
    run.world = run.ready.recv()
    yield run
    run.process.terminate()
    run.process.join(LIMIT_S)
    assert run.process.exitcode == 0
    run.close()


def test_time_goes_by(run):
    before = run.state.read()
    after = run.until(lambda state: state["t"] > before["t"] + 0.1)
    # Never faster than the clock, however far behind a busy machine is.
    assert after["t"] - before["t"] <= after["wall"] - before["wall"] + 0.1 + 1e-3


def test_the_joints_follow_a_controller_that_lives(run):
    assert run.state.read()["q"] == pytest.approx(HOME, abs=1e-3)
    target = HOME + np.array([0.1, 0, 0, 0, 0, 0])
    assert run.drive(target) == pytest.approx(target, abs=2e-3)
    time.sleep(0.3)
    held = run.state.read()
    run.arm.write(q=HOME)
    time.sleep(0.3)
    assert run.state.read()["q"] == pytest.approx(held["q"], abs=1e-4), "the controller was dead"
    assert run.drive(HOME, powered=False) == pytest.approx(held["q"], abs=1e-4), "the brakes were on"
    assert run.drive(HOME) == pytest.approx(HOME, abs=2e-3)


def test_the_fingers_obey_and_say_which_command(run):
    run.fingers.write(count=1, stop=False, width_m=0.03, force_n=20.0)
    run.until(lambda state: state["gripper_count"] == 1 and state["busy"])
    state = run.until(lambda state: not state["busy"])
    assert state["width_m"] == pytest.approx(0.03, abs=5e-4)
    run.fingers.write(count=2, stop=False, width_m=0.11, force_n=20.0)
    run.until(lambda state: state["width_m"] > 0.05)
    run.fingers.write(count=3, stop=True)
    stopped = run.until(lambda state: state["gripper_count"] == 3 and not state["busy"])
    time.sleep(0.2)
    width = run.state.read()["width_m"]
    assert width == pytest.approx(stopped["width_m"], abs=2e-3)
    assert width < 0.1


def test_the_poses_of_what_is_seen_move_with_the_arm(run):
    visuals = run.world["visuals"]
    poses = Record(poses_dtype(len(visuals)), run.world["poses"])
    try:
        before = poses.read()
        run.drive(HOME + np.array([0.2, 0, 0, 0, 0, 0]))
        after = poses.read()
        moved = np.abs(after["poses"] - before["poses"]).max(axis=(1, 2)) > 0.01
        kinds = {visual.kind for visual, m in zip(visuals, moved, strict=True) if m}
        assert after["t"] > before["t"]
        assert kinds == {"arm", "gripper"}
        run.drive(HOME)
    finally:
        poses.close()


def test_a_scene_that_is_not_there_is_said():
    run = Run(scene="nowhere")
    try:
        assert "nowhere" in run.ready.recv()["error"]
        run.process.join(LIMIT_S)
        assert run.process.exitcode == 0
    finally:
        run.close()


def test_an_interrupt_is_for_the_supervisor(run):
    os.kill(run.process.pid, signal.SIGINT)
    t = run.state.read()["t"]
    run.until(lambda state: state["t"] > t + 0.3)
    assert run.process.is_alive()
