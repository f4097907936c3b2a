"""How well an object can be grasped after a push."""

from dataclasses import replace

import numpy as np
import pytest

from policy.finger_clearance import OpenGripper
from policy.learned.graspability import Graspability
from policy.network.encoding import GRASP
from policy.push.outcome import PushForwardModel, PushOutcome
from robotcell.config import CellConfig
from robotcell.errors import ConfigError
from tests.robotcell.maps import heightmap

CONFIG = CellConfig()
GRIPPER = OpenGripper.of(CONFIG)
STAYS = PushOutcome({}, frozenset())


class Network:
    """Grasps anything anywhere, best along +x, and keeps what it was shown."""

    def __init__(self, value=0.9):
        self.value = value
        self.seen = []

    def maps(self, planes, cells, primitive):
        assert primitive == GRASP
        self.seen.append((planes, cells))
        q = np.full((8, *cells.shape), np.float32(np.nan))
        q[:, cells] = 0.1
        q[0, cells] = self.value
        return q


class View:
    """Boxes of 50 x 50 x 50 mm on a bare table, by their first row and column."""

    def __init__(self, *corners, network=None):
        self.network = network or Network()
        height_m = np.zeros(CONFIG.workspace.shape, np.float32)
        labels = np.zeros(CONFIG.workspace.shape, np.int32)
        for label, (row, col) in enumerate(corners, start=1):
            place = slice(row, row + 25), slice(col, col + 25)
            height_m[place], labels[place] = 0.05, label
        color = np.full((*labels.shape, 3), 90, np.uint8)
        color[labels > 0] = 200, 40, 40
        view = replace(heightmap(height_m), color=color)
        self.model = PushForwardModel(labels, view)
        self.graspability = Graspability(self.network, self.model, labels, view, GRIPPER)

    def promise(self, label=1, outcome=STAYS):
        return self.graspability.after(label, self.model.height_around(label, outcome))


def moved(label, x_m, y_m=0.0, turn=0.0):
    cos, sin = np.cos(turn), np.sin(turn)
    return PushOutcome({label: np.array([[cos, -sin, x_m], [sin, cos, y_m], [0, 0, 1]])}, frozenset())


def test_an_object_that_stands_alone_promises_the_q_of_its_grasps():
    assert View((100, 100)).promise() == pytest.approx(0.9, abs=0.15)


def test_neighbours_on_both_sides_of_the_jaw_leave_little():
    assert View((100, 100), (100, 73), (100, 127)).promise() < 0.1


def test_a_push_that_takes_a_neighbour_away_promises_more():
    view = View((100, 100), (100, 73), (100, 127))
    before = view.promise()
    one = view.promise(outcome=moved(2, -0.05))
    both = view.promise(outcome=PushOutcome({**moved(2, -0.05).moves, **moved(3, 0.05).moves}, frozenset()))
    assert before == one  # the other finger still finds no room
    assert both > before + 0.5


def test_the_object_that_moves_away_promises_as_much():
    view = View((100, 100), (100, 73), (100, 127))
    # Out of the row, and turned: the grasps go with it.
    assert view.promise(outcome=moved(1, 0.05, 0.25, 0.3)) == pytest.approx(View((100, 100)).promise(), abs=0.1)


def test_the_network_is_asked_once_for_an_object_and_sees_no_other():
    view = View((100, 100), (100, 127))
    view.promise()
    view.promise(outcome=moved(2, 0.05))
    ((planes, cells),) = view.network.seen
    assert np.count_nonzero(cells) == 25 * 25
    assert not planes[0][~cells].any()
    assert len(np.unique(planes[2:, ~cells], axis=1).T) == 1


def test_broken_maps_are_an_error():
    with pytest.raises(ConfigError, match="grasp maps hold"):
        View((100, 100), network=Network(np.nan)).promise()
