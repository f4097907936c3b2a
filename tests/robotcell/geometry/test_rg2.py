from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.geometry import rg2

widths = st.floats(rg2.MIN_WIDTH_M, rg2.MAX_WIDTH_M)


@given(widths)
def test_width_and_angle_are_inverse(width: float) -> None:
    assert rg2.width_at(rg2.crank_angle(width)) == pytest.approx(width, abs=1e-9)


@given(widths, widths)
def test_wider_fingers_reach_less_far(a: float, b: float) -> None:
    # Around the closed angle the arc is flat, so the tips advance by a few hundredths of a millimetre first.
    narrow, wide = sorted((a, b))
    assert rg2.tip_retraction(wide) >= rg2.tip_retraction(narrow) - 5e-5


def test_stroke_and_depth_are_those_that_were_measured() -> None:
    assert rg2.tip_retraction(0.0) == 0.0
    assert rg2.tip_retraction(rg2.MAX_WIDTH_M) == pytest.approx(0.040, abs=2e-4)


@pytest.mark.parametrize("width", [-1e-3, 0.111, float("nan")])
def test_an_opening_out_of_range_is_refused(width: float) -> None:
    with pytest.raises(ValueError, match="range of 0 to 110 mm"):
        rg2.crank_angle(width)
