"""Collecting in the twin: kept when interrupted, gone on with, by hand, and never mixed with something else."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.collect.acquisition import collect, collect_by_hand
from calibration.collect.capture import capture_view
from calibration.collect.running_estimate import running_estimate
from calibration.collect.session import (
    REFUSED,
    camera_model,
    load_records,
    open_session,
    read_session,
)
from calibration.solve.se3 import difference
from calibration.target.detection import Detector
from calibration.target.held_board import HeldBoard
from robotcell.config import load_config
from robotcell.errors import ConfigError, DeviceFault, GuardTripped
from robotcell.interfaces import Intrinsics, RgbdFrame
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import JointMove, MotionPlan
from robotcell.perception.board_plate import DEFAULT_BOARD, held_by_gripper
from sim_twin.devices.backend import open_twin
from sim_twin.options import TwinOptions
from sim_twin.world.held_board import T_flange_board

CONFIG = load_config(
    None,
    {
        "backend.options.board": True,
        "backend.options.objects": 1,
        "backend.options.seed": 5,
        # An arm that is there sooner sees the same.
        "motion.joint_acceleration_rad_s2": 4.0,
        "backend.options.camera_offset": [0.005, -0.004, 0.006, 0.004, 0.005, -0.006],
    },
)
HELD = HeldBoard(DEFAULT_BOARD, held_by_gripper(DEFAULT_BOARD))
OPTICS = Intrinsics(640, 480, 617.3, 617.3, 320.0, 240.0)


class Progress:
    """Writes down what it is told, and interrupts after some views."""

    def __init__(self, interrupt_after=None):
        self.taken, self.refused, self.estimates = [], [], []
        self._interrupt_after = interrupt_after

    def moving(self, taken, count):
        pass

    def captured(self, capture, taken, count, estimate):
        self.refused.append(capture.detection.refused)
        self.taken.append(taken)
        self.estimates.append(estimate)
        if taken == self._interrupt_after:
            raise KeyboardInterrupt

    def skipped(self, why):
        raise AssertionError(why)


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A session that was interrupted after three views, gone on with to six, and ended by hand with one more."""
    folder = tmp_path_factory.mktemp("session")
    told = {}
    with open_twin(CONFIG)[0] as cell:
        open_session(folder, DEFAULT_BOARD, cell.camera.read(), resume=False)
        q_first = cell.arm.state().q
        told["interrupted"] = Progress(interrupt_after=3)
        with pytest.raises(KeyboardInterrupt):
            collect(cell, folder, HELD, 6, 1, told["interrupted"])
        told["kept"] = len(read_session(folder))
        open_session(folder, DEFAULT_BOARD, cell.camera.read(), resume=True)
        told["resumed"], q_resumed = Progress(), cell.arm.state().q
        collect(cell, folder, HELD, 6, 1, told["resumed"])
        told["back"] = np.abs(cell.arm.state().q - q_resumed).max()
        told["by hand"] = Progress()
        answers = iter([True, False, True, False])
        collect_by_hand(cell, folder, DEFAULT_BOARD, 9, lambda: next(answers), told["by hand"])
        # At home the board hangs on edge before the camera: of no use, and not a view.
        home = MotionPlan("home", cell.arm.state().q, (JointMove("home", q_first, 1.0, 1.4),))
        cell.executor.run(check_path(home, CONFIG))
        collect_by_hand(cell, folder, DEFAULT_BOARD, 9, lambda: next(answers), told["by hand"])
        cell.latch.trip("a hand in the cell")
        told["latched"] = Progress()
        with pytest.raises(GuardTripped):
            collect(cell, folder, HELD, 8, 1, told["latched"])
        cell.recover()
        cell.arm.start_joints(q_first + 0.3, 0.5, 1.0)
        pushed = replace(cell, devices=replace(cell.devices, clock=PushedArmClock(cell)))
        with pytest.raises(DeviceFault, match="does not come to rest"):
            capture_view(pushed, Detector(DEFAULT_BOARD))
    return folder, told


class PushedArmClock:
    """A cell's clock, while somebody keeps pushing its arm."""

    def __init__(self, cell):
        self._clock, self._arm, self._start = cell.clock, cell.arm, cell.arm.state().q

    def now(self):
        return self._clock.now()

    def sleep(self, dt):
        self._arm.kick()
        self._clock.sleep(dt)
        if not self._arm.moving:
            way = -0.05 if (self._arm.state().q > self._start).all() else 0.05
            self._arm.start_joints(self._arm.state().q + way, 0.5, 1.0)


def test_an_interrupted_collection_keeps_its_views_and_is_gone_on_with(collected):
    folder, told = collected
    assert told["interrupted"].taken == [1, 2, 3]
    assert told["kept"] == 3
    assert told["resumed"].taken[-1] == 6
    assert [record.name for record in load_records(folder)] == [f"{i:03d}" for i in range(1, 8)]


def test_the_arm_goes_back_to_where_it_began(collected):
    assert collected[1]["back"] < 0.01


def test_a_record_holds_the_pose_of_the_moment_of_the_image(collected):
    """What the corners say by the truth of the twin is what the record says of the arm."""
    folder, _ = collected
    views = read_session(folder)
    X = TwinOptions.model_validate(CONFIG.backend.options).camera_pose(CONFIG.camera)
    for T_base_flange, corners in zip(views.T_base_flange, views.corners, strict=True):
        points = np.array([DEFAULT_BOARD.corners()[int(i)] for i in corners.ids])
        T = np.linalg.inv(X) @ T_base_flange @ T_flange_board(5)
        in_camera = points @ T[:3, :3].T + T[:3, 3]
        px = in_camera[:, :2] / in_camera[:, 2:] * OPTICS.fx + (OPTICS.cx, OPTICS.cy)
        assert np.abs(np.median(corners.px - px, axis=0)).max() < 0.1
        seen = corners.depth_m > 0
        assert seen.mean() > 0.7
        assert abs(np.median(corners.depth_m[seen] - in_camera[seen, 2])) < 0.004
    for record in load_records(folder):
        T = np.array(record.T_base_tcp)
        np.testing.assert_allclose(T[:3, :3], np.array(record.T_base_flange)[:3, :3], atol=1e-9)


def test_the_running_estimate_comes_near_the_truth(collected):
    folder, told = collected
    assert told["interrupted"].estimates == [None, None, None]
    estimate = running_estimate(read_session(folder))
    X = TwinOptions.model_validate(CONFIG.backend.options).camera_pose(CONFIG.camera)
    assert np.linalg.norm(difference(estimate.T_base_camera, X)[:3]) < 0.005
    assert np.linalg.norm(difference(estimate.T_flange_board, T_flange_board(5))[:3]) < 0.005


def test_a_view_without_the_board_is_told_and_does_not_count(collected):
    folder, told = collected
    assert told["by hand"].taken == [7, 7]
    assert told["by hand"].refused[0] == ""
    assert told["by hand"].refused[1] != ""
    assert len(list((folder / REFUSED).glob("*.png"))) >= 1


def test_nothing_moves_while_a_stop_is_latched(collected):
    assert collected[1]["latched"].taken == []


def frame(**changes):
    values = {"serial": "1", "intrinsics": OPTICS, **changes}
    return RgbdFrame(0.0, 1, np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32), **values)


def test_a_session_is_of_one_camera_and_one_board(tmp_path):
    folder = tmp_path / "session"
    with pytest.raises(ConfigError, match="no session folder"):
        open_session(folder, DEFAULT_BOARD, frame(), resume=True)
    first = open_session(folder, DEFAULT_BOARD, frame(), resume=False)
    assert first.camera == camera_model(frame())
    with pytest.raises(ConfigError, match="there is a session already"):
        open_session(folder, DEFAULT_BOARD, frame(), resume=False)
    assert open_session(folder, DEFAULT_BOARD, frame(), resume=True) == first
    with pytest.raises(ConfigError, match="its camera is"):
        open_session(folder, DEFAULT_BOARD, frame(serial="2"), resume=True)
    other = DEFAULT_BOARD.model_copy(update={"square_m": 0.0301})
    with pytest.raises(ConfigError, match="its board is"):
        open_session(folder, other, frame(), resume=True)
