"""One served cell for all tests of the drivers; those that break one for good start their own."""

from __future__ import annotations

from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

import pytest

from tests.robotcell.drivers.served_cell import CAMERA_PORT, HOST, MODBUS_PORT, serve

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sim_twin.wire.cell import ServedCell


@pytest.fixture(scope="package", autouse=True)
def tracker() -> None:
    """The one process that multiprocessing keeps for shared memory is there before a test, and is none of its leaks."""
    resource_tracker.ensure_running()


@pytest.fixture(scope="package")
def served(tracker: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedCell]:
    """The shared cell. A test that gives it faults clears them."""
    with serve(tmp_path_factory.mktemp("scene"), HOST, MODBUS_PORT, CAMERA_PORT) as cell:
        yield cell
