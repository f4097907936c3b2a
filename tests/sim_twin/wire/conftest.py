"""Processes of a served cell share memory; one served cell is shared by the tests that do not break it."""

from __future__ import annotations

from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

import pytest

from robotcell.config import load_config
from sim_twin.wire.cell import ServedCell
from tests.addresses import loopback

if TYPE_CHECKING:
    from collections.abc import Iterator

HOST = loopback(23)
ONE = load_config(None, {"backend.options.objects": 1})


@pytest.fixture(scope="package", autouse=True)
def tracker() -> None:
    """The one process that multiprocessing keeps for shared memory is there before a test, and is none of its leaks."""
    resource_tracker.ensure_running()


@pytest.fixture(scope="package")
def shared_cell(tracker: None) -> Iterator[ServedCell]:
    """The served cell that tests share."""
    with ServedCell(ONE, HOST, modbus_port=0, camera_port=0) as cell:
        yield cell


@pytest.fixture
def served(shared_cell: ServedCell) -> Iterator[ServedCell]:
    """The shared cell, without faults."""
    yield shared_cell
    shared_cell.clear()
