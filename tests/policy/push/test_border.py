"""The border of an object."""

import numpy as np
import pytest

from policy.push.border import border_occupancy


def test_the_border_of_an_object_is_occupied_by_what_stands_beside_it():
    heights = np.zeros((100, 100), np.float32)
    mask = np.zeros((100, 100), np.bool_)
    mask[40:60, 40:60] = True
    heights[mask] = 0.05
    assert border_occupancy(mask, heights, 0.002) == 0.0
    heights[30:70, 60:70] = 0.05
    # The border is 40 x 40 cells less 20 x 20, the neighbour takes 10 x 40 of it.
    assert border_occupancy(mask, heights, 0.002) == pytest.approx(400 / 1200)
    heights[30:70, 60:70] = 0.015
    assert border_occupancy(mask, heights, 0.002) == 0.0
    assert border_occupancy(np.zeros_like(mask), heights, 0.002) == 0.0
