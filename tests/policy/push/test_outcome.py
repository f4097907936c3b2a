"""The forward model of pushes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy.push.line import free_to_descend, push_line
from policy.push.outcome import PushForwardModel
from robotcell.config import CellConfig
from tests.robotcell.maps import heightmap

CONFIG = CellConfig()
RESOLUTION_M = CONFIG.workspace.resolution_m
PUSH_M = CONFIG.motion.push_m


class Table:
    """Boxes of cells on a bare table."""

    def __init__(self, *boxes, height_m=0.05):
        self.height_m = np.zeros(CONFIG.workspace.shape, np.float32)
        self.labels = np.zeros(CONFIG.workspace.shape, np.int32)
        for label, (row, col, rows, cols, *higher) in enumerate(boxes, start=1):
            place = slice(row, row + rows), slice(col, col + cols)
            self.height_m[place], self.labels[place] = (higher or [height_m])[0], label

    def push(self, cell, rotation):
        free = free_to_descend(self.height_m, CONFIG.workspace)
        line = push_line(self.height_m, free, cell, rotation, PUSH_M, RESOLUTION_M)
        assert line is not None
        model = PushForwardModel(self.labels, heightmap(self.height_m))
        return model, line, model.predict(line, rotation)


def border_gain(model, label, outcome):
    return model.border_gain(label, model.height_around(label, outcome))


def shift(outcome, label, cell):
    """How far the middle of an object goes [m], along x and y."""
    before = (np.array(cell[::-1]) + 0.5) * RESOLUTION_M
    move = outcome.moves[label]
    return move[:2, :2] @ before + move[:2, 2] - before


@settings(max_examples=16, derandomize=True, deadline=None)
@given(rotation=st.integers(0, 15))
def test_a_block_goes_with_the_fingers_and_its_neighbours_stay(rotation):
    table = Table((100, 100, 25, 25), (20, 20, 25, 25))
    _, line, outcome = table.push((112, 112), rotation)
    assert set(outcome.moves) == {1}
    theta = 2 * math.pi * rotation / 16
    way = shift(outcome, 1, (112, 112))
    gap = np.hypot(112 - line.row, 112 - line.col) * RESOLUTION_M
    # From where the fingers meet it, which are 10 mm long on that side; at a corner it also turns.
    expected = PUSH_M - (gap - 0.010 - 0.025)
    assert way @ (math.cos(theta), math.sin(theta)) == pytest.approx(expected, abs=0.012)
    assert abs(way @ (-math.sin(theta), math.cos(theta))) < 0.02
    assert not outcome.lost


def test_a_push_beside_the_middle_turns_the_block():
    _, _, outcome = Table((100, 100, 25, 25)).push((124, 112), 0)
    angle = math.atan2(outcome.moves[1][1, 0], outcome.moves[1][0, 0])
    # Pushed at larger y, towards +x: clockwise in a frame whose z is up.
    assert angle < -0.2


def test_what_is_met_on_the_way_is_pushed_on():
    _, _, outcome = Table((100, 60, 25, 25), (100, 95, 25, 25)).push((112, 72), 0)
    assert set(outcome.moves) == {1, 2}
    first, second = shift(outcome, 1, (112, 72)), shift(outcome, 2, (112, 107))
    assert 0 < second[0] < first[0]


def test_fingers_pass_over_what_is_lower_than_their_tips():
    # The low one lies beside the way of the high one and in that of the fingers.
    table = Table((92, 60, 20, 25, 0.10), (112, 60, 25, 25, 0.03))
    _, line, outcome = table.push((111, 72), 0)
    assert line.top_m == pytest.approx(0.10)
    assert outcome.moves[1][0, 2] > 0.05
    assert 2 not in outcome.moves or abs(shift(outcome, 2, (124, 72))[0]) < 0.02


def test_what_is_lower_than_the_tips_is_pushed_by_what_they_push():
    _, _, outcome = Table((100, 60, 25, 25, 0.10), (100, 95, 25, 25, 0.03)).push((112, 72), 0)
    first, second = shift(outcome, 1, (112, 72)), shift(outcome, 2, (112, 107))
    assert 0.02 < second[0] < first[0]


def test_specks_in_the_shadow_behind_an_object_are_not_pushed():
    clear, specked = (Table((100, 60, 25, 25), (100, 135, 25, 25)) for _ in range(2))
    # Between the two the camera sees little, and takes it for the first.
    specked.height_m[100:125, 85:100] = np.nan
    specked.height_m[100:125:4, 85:100:3], specked.labels[100:125, 85:100] = 0.03, 1
    far = clear.push((112, 72), 0)[2]
    assert set(far.moves) == {1}
    np.testing.assert_allclose(specked.push((112, 72), 0)[2].moves[1], far.moves[1], atol=0.003)


def test_what_is_narrow_is_an_obstacle_all_the_same():
    _, _, outcome = Table((100, 60, 25, 25), (90, 95, 45, 2)).push((112, 72), 0)
    assert set(outcome.moves) == {1, 2}


def test_what_stands_in_the_mouth_of_another_is_not_driven_out():
    table = Table((100, 60, 20, 20), (90, 100, 40, 40), (86, 106, 18, 18))
    # The second is open towards smaller rows, and the third stands in it.
    table.labels[90:114, 103:127] = table.height_m[90:114, 103:127] = 0
    table.labels[86:104, 106:124], table.height_m[86:104, 106:124] = 3, 0.05
    _, _, away = table.push((110, 70), 8)
    assert set(away.moves) == {1}
    _, _, out = table.push((125, 115), 12)
    assert set(out.moves) == {2, 3}
    assert shift(out, 2, (110, 120))[1] < shift(out, 3, (95, 115))[1] < -0.02


def test_a_push_away_from_a_neighbour_frees_the_border():
    table = Table((100, 100, 25, 25), (100, 126, 25, 25))
    model, _, away = table.push((112, 112), 4)
    assert border_gain(model, 1, away) > 0.15
    assert border_gain(model, 2, away) > 0.15
    _, _, together = table.push((112, 112), 0)
    assert border_gain(model, 1, together) == pytest.approx(0, abs=0.05)


def test_an_object_without_neighbours_has_nothing_to_be_freed_of():
    model, _, outcome = Table((100, 100, 25, 25)).push((112, 112), 3)
    assert border_gain(model, 1, outcome) == 0.0


def test_cells_are_uncovered_by_what_leaves_them():
    table = Table((100, 60, 25, 25), (100, 90, 25, 25))
    first, second = table.labels == 1, table.labels == 2
    model, _, outcome = table.push((112, 72), 4)
    assert set(outcome.moves) == {1}
    assert model.uncovered_share(first, outcome) > 0.9
    assert model.uncovered_share(second, outcome) == 0.0
    # The first comes to stand where the second stood.
    model, _, along = table.push((112, 72), 0)
    assert model.uncovered_share(first, along) > 0.9
    assert 0.1 < model.uncovered_share(second, along) < 0.9


def test_what_ends_at_the_rim_may_be_lost():
    assert Table((100, 180, 25, 25)).push((112, 192), 0)[2].lost == {1}
    assert not Table((100, 180, 25, 25)).push((112, 192), 8)[2].lost
    assert Table((100, 130, 25, 25), (100, 165, 25, 25)).push((112, 142), 0)[2].lost == {2}


def test_the_same_push_gives_the_same():
    table = Table((100, 100, 25, 25), (90, 127, 25, 25), (126, 100, 20, 40))
    outcomes = [table.push((105, 105), 1)[2].moves for _ in range(2)]
    assert outcomes[0].keys() == outcomes[1].keys()
    assert all(np.array_equal(outcomes[0][i], outcomes[1][i]) for i in outcomes[0])


def test_holes_and_specks_are_no_obstacles():
    table = Table((100, 100, 25, 25))
    table.height_m[60:70, 60:70] = np.nan
    table.labels[112, 150:153] = 9
    _, _, outcome = table.push((112, 112), 0)
    assert set(outcome.moves) == {1}
