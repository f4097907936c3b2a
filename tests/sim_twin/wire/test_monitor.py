import socket
import time

import numpy as np
import pytest

from sim_twin.wire.monitor import connected_clients, pace
from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE


def reading(t, wall, tick, skipped=0):
    state, command = np.zeros(1, CELL_STATE), np.zeros(1, ARM_COMMAND)
    state["t"], state["wall"], state["skipped"], command["tick"] = t, wall, skipped, tick
    return state[0], command[0]


def test_the_pace_of_a_cell_that_falls_behind():
    kept = pace(reading(3.0, 100.0, 500), reading(4.5, 102.0, 1480, skipped=120))
    assert kept.real_time_factor == pytest.approx(0.75)
    assert kept.controller_hz == pytest.approx(490)
    assert kept.skipped == 120


def test_a_controller_that_began_anew_has_no_pace_that_overflows():
    assert pace(reading(0, 0, 500), reading(1, 1, 0)).controller_hz == pytest.approx(-500)


def test_connections_are_counted_by_endpoint():
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        endpoints = {name: "{}:{}".format(*s.getsockname()) for name, s in (("one", one), ("other", other))}
        with socket.create_connection(one.getsockname()), socket.create_connection(one.getsockname()):
            end = time.monotonic() + 5
            while (counts := connected_clients(endpoints)) != {"one": 2, "other": 0}:
                assert time.monotonic() < end, counts
                time.sleep(0.01)
