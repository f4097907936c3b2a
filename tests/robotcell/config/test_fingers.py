"""What mounted finger tips reach, and what a cell's file asks of them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.cell import open_cell
from robotcell.config import CellConfig, load_config
from robotcell.config.fingers import closed_width, finger_problems, gripper_range, narrowest_hold
from robotcell.errors import ConfigError, UnsafeMotion
from robotcell.geometry import rg2
from robotcell.motion.config_check import check_config
from robotcell.motion.executor import Ending
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, MotionPlan

INWARDS, OUTWARDS = 0.02, -0.005


def cell(offset_m: float, **settings: float) -> CellConfig:
    overrides = {"backend.options.fingertip_offset_m": offset_m, "backend.options.objects": 1}
    return load_config(None, {**overrides, **{key.replace("__", "."): value for key, value in settings.items()}})


def hardware(offset_m: float) -> CellConfig:
    return load_config(
        None,
        {
            "backend.name": "hardware",
            "backend.options.arm.host": "127.0.0.1",
            "backend.options.gripper.host": "127.0.0.1",
            "backend.options.gripper.fingertip_offset_m": offset_m,
        },
    )


@given(offset=st.floats(-0.05, 0.05), share=st.floats(0, 1))
def test_every_opening_in_the_range_is_one_of_the_linkage(offset: float, share: float) -> None:
    reach = rg2.range_with_tips(offset)
    width = reach.min_width_m + share * (reach.max_width_m - reach.min_width_m)
    assert -1e-12 <= width <= rg2.MAX_WIDTH_M + 1e-12
    assert rg2.MIN_WIDTH_M - 1e-9 <= width + 2 * offset <= rg2.MAX_WIDTH_M + 1e-9
    assert -1e-3 <= rg2.tip_retraction(width, offset) <= 0.041


def test_the_range_is_that_of_the_tips_on_either_backend() -> None:
    for config in (cell(INWARDS), hardware(INWARDS)):
        assert gripper_range(config).max_width_m == pytest.approx(0.07)
        assert closed_width(config) == 0.0
    for config in (cell(OUTWARDS), hardware(OUTWARDS)):
        assert gripper_range(config).max_width_m == pytest.approx(0.11)
        assert closed_width(config) == pytest.approx(0.01)
        # Fingers that are closed as far as they go hold nothing.
        assert narrowest_hold(config) > closed_width(config)


@pytest.mark.parametrize("make", [cell, hardware])
def test_a_preshape_that_the_tips_cannot_reach_is_refused_before_anything_is_opened(make: type[CellConfig]) -> None:
    with pytest.raises(ConfigError, match=r"gripper\.preshape_m = 0\.08: .* to 70 mm .*\+20\.0 mm inwards"):
        check_config(make(INWARDS))
    check_config(make(OUTWARDS))
    check_config(make(0.015))


def test_a_cell_with_such_tips_does_not_open() -> None:
    opened = open_cell(cell(INWARDS))
    with pytest.raises(ConfigError, match=r"preshape_m"), opened:
        pytest.fail("it opened")


def test_tips_that_are_others_than_the_file_says_are_named() -> None:
    assert "reports finger tips that reach +20.0 mm" in finger_problems(cell(0.0), rg2.range_with_tips(INWARDS))[0]
    # The gripper counts in tenths of a millimetre.
    assert not finger_problems(cell(0.01002), rg2.range_with_tips(0.0100))


def test_a_plan_with_a_width_beyond_the_tips_is_refused() -> None:
    config = cell(INWARDS, gripper__preshape_m=0.06)
    for width in (-0.001, 0.071):
        plan = MotionPlan("test", config.motion.home_q, (Grip("open", width, 20.0),))
        with pytest.raises(UnsafeMotion, match="0 to 70 mm"):
            check_path(plan, config)


@pytest.mark.parametrize(("offset", "preshape"), [(INWARDS, 0.06), (OUTWARDS, 0.08)])
def test_fingers_with_tips_close_as_far_as_they_go_and_open_to_their_preshape(offset: float, preshape: float) -> None:
    config = cell(offset, gripper__preshape_m=preshape)
    with open_cell(config) as opened:
        reach = opened.gripper.range()
        assert reach == gripper_range(config)
        for width in (reach.min_width_m, reach.max_width_m, preshape):
            assert opened.grip(width).ending is Ending.DONE
            assert opened.gripper.state().width_m == pytest.approx(width, abs=0.001)
        with pytest.raises(UnsafeMotion):
            opened.grip(reach.max_width_m + 0.002)
        with pytest.raises(UnsafeMotion):
            opened.grip(reach.min_width_m - 0.002)
