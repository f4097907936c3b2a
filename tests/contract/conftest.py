"""The cells that the contract is stated for: one entry per backend, opened through the public interface only.

The backend `hardware` drives a cell that a twin serves over the devices' own protocols. In each module the tests that
open a cell of their own come first: a device serves one client.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.cell import open_cell
from robotcell.config import load_config

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.cell import Cell
    from robotcell.config import CellConfig

TWIN = {"backend.name": "twin", "backend.options.objects": 1}
HOST, MODBUS_PORT, CAMERA_PORT = "127.0.0.42", 15042, 30442
BACKENDS = {
    "twin": TWIN,
    "hardware": {
        "backend.name": "hardware",
        "backend.options.arm.host": HOST,
        "backend.options.gripper.host": HOST,
        "backend.options.gripper.port": MODBUS_PORT,
        "backend.options.camera.source": f"twin://{HOST}:{CAMERA_PORT}",
    },
}
PERIOD_S = 0.008
OPEN_M = 0.1


@pytest.fixture(scope="package", params=sorted(BACKENDS))
def config(request: pytest.FixtureRequest) -> Iterator[CellConfig]:
    """A cell file of each backend, and what it needs around it."""
    with ExitStack() as stack:
        if request.param == "hardware":
            from sim_twin.wire.cell import ServedCell

            stack.enter_context(ServedCell(load_config(None, TWIN), HOST, MODBUS_PORT, CAMERA_PORT))
        yield load_config(None, BACKENDS[request.param])


@pytest.fixture
def closed_cell(config: CellConfig) -> Iterator[Cell]:
    """A cell that is not connected yet; closed whatever the test does."""
    cell = open_cell(config)
    yield cell
    cell.close()


@pytest.fixture(scope="module")
def connected_cell(config: CellConfig) -> Iterator[Cell]:
    """A connected cell for all tests of a module."""
    with open_cell(config) as connected:
        yield connected


@pytest.fixture
def cell(connected_cell: Cell) -> Cell:
    """A connected cell, its arm at home and its fingers open."""
    arm, gripper, clock = connected_cell.arm, connected_cell.gripper, connected_cell.clock
    home = np.array(connected_cell.config.motion.home_q)
    while arm.moving:
        clock.sleep(PERIOD_S)
    if np.abs(arm.state().q - home).max() > 1e-3:
        arm.start_joints(home, 2.0, 4.0)
    gripper.start_width(OPEN_M, 20.0)
    clock.sleep(PERIOD_S)
    while arm.moving or gripper.state().busy:
        arm.kick()
        clock.sleep(PERIOD_S)
    return connected_cell
