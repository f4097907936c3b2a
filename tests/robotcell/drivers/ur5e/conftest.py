"""The tests of the arm keep its periods."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from tests.robotcell.drivers.ur5e.served_arm import make_arm, works

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.drivers.ur5e.arm import UR5e
    from sim_twin.wire.cell import ServedCell


@pytest.fixture(autouse=True)
def _on_time() -> Iterator[None]:
    """On a busy machine a test must not miss its periods: go ahead of everything else, where the system allows it."""
    if sys.platform != "linux":
        yield
        return
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture(scope="module")
def connection(served: ServedCell) -> Iterator[UR5e]:
    """A connected arm for the last tests of a file: those that leave the connection as it is."""
    with make_arm() as arm:
        yield arm


@pytest.fixture
def shared_arm(served: ServedCell, connection: UR5e) -> Iterator[UR5e]:
    """It, at home; afterwards the cell is whole again."""
    works(connection)
    yield connection
    served.clear()
