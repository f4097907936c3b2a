import re
from dataclasses import replace

import numpy as np
import pytest

from calibration.verify import Touch, Verification, choose_spots, go_home, touch_table
from robotcell.config import CellConfig, load_config
from robotcell.errors import CalibrationError
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


def test_the_arm_feels_a_table_that_the_camera_sees_too_high():
    """The camera hangs 4 mm lower than it believes, too little for the plane of the table to be refused."""
    config = load_config(
        None, {"backend.options.objects": 6, "backend.options.camera_offset": [0.0, 0.0, -0.004, 0.0, 0.0, 0.0]}
    )
    with open_twin(config)[0] as cell:
        table, spots = choose_spots(cell, 3)
        assert len(spots) == 3
        apart = [np.linalg.norm(a - b) for i, a in enumerate(spots) for b in spots[:i]]
        assert min(apart) > 0.1
        found = [touch_table(cell, spot) for spot in spots[:2]]
        go_home(cell)
        at_home = np.abs(cell.arm.state().q - np.array(config.motion.home_q)).max()
    for touch in found:
        assert abs(touch.touched_m) < 0.001
        assert touch.difference_m == pytest.approx(0.004, abs=0.0015)
    assert "+4" in Verification(table, tuple(found)).problems(config)[0]
    assert at_home < 0.02


def test_a_table_that_is_not_there_ends_the_touch():
    """The camera sees the table 14 mm above where it is: the arm stops short of feeling for it for ever."""
    config = load_config(None, {"backend.options.objects": 1})
    with open_twin(config)[0] as cell:
        with pytest.raises(CalibrationError, match="met nothing down to 12 mm"):
            touch_table(cell, np.array([-0.45, 0.1, 0.014]))
        assert cell.arm.state().T_base_tcp[2, 3] > 0.02
