import re
from dataclasses import replace

import numpy as np
import pytest

from calibration.verify import HOVER_M, Touch, Verification, go_above, touch_table, verify
from robotcell.config import CellConfig, load_config
from robotcell.errors import CalibrationError, ConfigError, UnsafeMotion
from robotcell.perception.heightmap import TablePlane
from sim_twin.devices.backend import open_twin

FLAT = TablePlane(tilt_rad=0.001, offset_m=0.0005, rms_m=0.001)
CONFIG = CellConfig()


def touches(*differences_mm):
    return tuple(Touch(np.array([-0.5, 0.1 * i, 0.001 * d]), 0.0) for i, d in enumerate(differences_mm))


def test_a_calibration_that_agrees_with_the_arm_has_no_problems():
    assert Verification(FLAT, touches(0.5, -0.8, 1.2)).problems(CONFIG) == []
    assert Verification(FLAT, (Touch(np.zeros(3)),)).problems(CONFIG) == []


@pytest.mark.parametrize(
    ("table", "off", "words"),
    [
        (replace(FLAT, tilt_rad=0.03), (0.0,), "tilted by 1.72 degrees"),
        (replace(FLAT, offset_m=-0.008), (0.0,), "-8.0 mm off"),
        (FLAT, (3.5, 4.0, 4.2), r"\+4.0 mm from where the arm finds it"),
        (FLAT, (-3.5, 0.0, 3.5), "its rotation is off"),
    ],
)
def test_what_is_too_far_off_is_told(table, off, words):
    (problem,) = Verification(table, touches(*off)).problems(CONFIG)
    assert re.search(words, problem)


@pytest.fixture
def still_cell():
    """A twin with one object, whose camera is where it believes."""
    with open_twin(load_config(None, {"backend.options.objects": 1}))[0] as cell:
        yield cell


@pytest.mark.parametrize("off_m", [0.004, -0.004])
def test_the_arm_feels_a_table_that_the_camera_sees_too_high_or_too_low(off_m):
    """The camera hangs 4 mm lower or higher than it believes, too little for the table's plane to be refused."""
    config = load_config(
        None, {"backend.options.objects": 6, "backend.options.camera_offset": [0.0, 0.0, -off_m, 0.0, 0.0, 0.0]}
    )
    asked = []
    with open_twin(config)[0] as cell:
        found = verify(cell, 2, touch=True, consent=lambda: asked.append(cell.arm.state().q) or True, hovering=None)
        at_home = np.abs(cell.arm.state().q - np.array(config.motion.home_q)).max()
    assert len(asked) == 1
    assert len(found.touches) == 2
    places = [touch.place for touch in found.touches]
    assert np.linalg.norm(places[0] - places[1]) > 0.1
    for touch in found.touches:
        assert abs(touch.touched_m) < 0.001
        assert touch.difference_m == pytest.approx(off_m, abs=0.0015)
    assert re.search(rf"camera sees the table \{'+' if off_m > 0 else '-'}[34]\.\d mm from", found.problems(config)[0])
    assert at_home < 0.02


def test_over_a_spot_that_is_not_touched_the_tips_stand_still(still_cell):
    told = []

    def hovering(number, count, spot):
        T = still_cell.arm.state().T_base_tcp
        told.append((number, count, np.abs(T[:3, 3] - spot - (0.0, 0.0, HOVER_M)).max()))

    found = verify(still_cell, 2, touch=False, consent=lambda: True, hovering=hovering)
    assert [entry[:2] for entry in told] == [(1, 2), (2, 2)]
    assert max(entry[2] for entry in told) < 0.001
    assert [touch.touched_m for touch in found.touches] == [None, None]


def test_nothing_moves_without_consent(still_cell):
    before = still_cell.arm.state().q
    with pytest.raises(ConfigError, match="nothing was moved"):
        verify(still_cell, 2, touch=True, consent=lambda: False, hovering=None)
    assert np.array_equal(still_cell.arm.state().q, before)


def test_a_table_that_is_not_there_ends_the_touch(still_cell):
    """The camera sees the table 14 mm above where it is: the arm stops short of feeling for it for ever."""
    with pytest.raises(CalibrationError, match="met nothing down to 12 mm"):
        touch_table(still_cell, np.array([-0.45, 0.1, 0.014]))
    assert still_cell.arm.state().T_base_tcp[2, 3] > 0.02


def test_only_the_touch_itself_may_go_below_the_clearance(still_cell):
    """The limit of the touch holds for its own two motions, and leaves that of the cell as it is."""
    touched = touch_table(still_cell, np.array([-0.45, 0.1, 0.0]))
    assert abs(touched.touched_m) < 0.001
    with pytest.raises(UnsafeMotion, match="finger tips"):
        go_above(still_cell, np.array([-0.45, 0.1, 0.0]), -0.005)
