"""The cells that the contract is stated for, opened through the public interface only.

- `twin`: the simulated cell in this process.
- `served`: the drivers of the real devices, with a cell that a twin serves over the devices' own protocols.
- `real`: the cell of --cell-file, marked `hardware` and off by default. Its arm moves; see CONTRIBUTING.md.

A device serves one client, so that the tests which open a cell of their own come before those which share one.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.interfaces import ArmMode
from tests.addresses import loopback

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from sim_twin.wire.cell import ServedCell

TWIN = {"backend.name": "twin", "backend.options.objects": 1}
HOST, MODBUS_PORT, CAMERA_PORT = loopback(42), 15042, 30442
SERVED = {
    "backend.name": "hardware",
    "backend.options.arm.host": HOST,
    "backend.options.gripper.host": HOST,
    "backend.options.gripper.port": MODBUS_PORT,
    "backend.options.camera.source": f"twin://{HOST}:{CAMERA_PORT}",
    # The exposure of a simulated camera settles at once.
    "backend.options.camera.warm_up_frames": 3,
}
PERIOD_S = 0.008
OPEN_M = 0.08
# No test of the contract takes a joint further from home than this. A real arm that stands elsewhere is not moved.
NEAR_HOME_RAD = 0.35
# How fast a real arm moves, as a share of a simulated one: no joint exceeds 0.3 rad/s.
REAL_PACE = 0.25


@dataclass(frozen=True)
class Opened:
    """A cell to test.

    Attributes:
        config: of the cell.
        served: what serves it; None where nothing does.
        real: whether it may hurt somebody.
    """

    config: CellConfig
    served: ServedCell | None = None
    real: bool = False


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Every test that needs a cell, for every cell."""
    if "opened" in metafunc.fixturenames:
        cells: list[object] = ["twin", "served"]
        if metafunc.config.getoption("cell_file") is not None:
            cells.append(pytest.param("real", marks=pytest.mark.hardware))
        metafunc.parametrize("opened", cells, indirect=True, scope="package")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the tests in this folder, those that share a connected cell come last. Pytest then groups them by cell."""
    places = [i for i, item in enumerate(items) if Path(__file__).parent in item.path.parents]
    ours = sorted((items[i] for i in places), key=lambda item: "connected_cell" in getattr(item, "fixturenames", ()))
    for i, item in zip(places, ours, strict=True):
        items[i] = item


@pytest.fixture(scope="package")
def opened(request: pytest.FixtureRequest) -> Iterator[Opened]:
    """The configuration of each cell, and what it needs around it."""
    with ExitStack() as stack:
        if request.param == "twin":
            yield Opened(load_config(None, TWIN))
        elif request.param == "served":
            from sim_twin.wire.cell import ServedCell

            served = stack.enter_context(ServedCell(load_config(None, TWIN), HOST, MODBUS_PORT, CAMERA_PORT))
            yield Opened(load_config(None, SERVED), served)
        else:
            yield Opened(load_config(Path(request.config.getoption("cell_file"))), real=True)


@pytest.fixture(scope="package")
def config(opened: Opened) -> CellConfig:
    """The configuration of each cell."""
    return opened.config


@pytest.fixture
def served(opened: Opened) -> ServedCell:
    """What serves the cell; a test that gives it faults is skipped for the other cells."""
    if opened.served is None:
        pytest.skip("this cell takes no faults")
    return opened.served


@pytest.fixture
def pace(opened: Opened) -> float:
    """How fast motions are, as a share of how fast a simulated arm does them.

    With speeds times `pace` and accelerations times its square, a motion is the same and takes 1 / `pace` of the time.
    """
    return REAL_PACE if opened.real else 1.0


@pytest.fixture
def closed_cell(config: CellConfig) -> Iterator[Cell]:
    """A cell that is not connected yet; closed whatever the test does."""
    cell = open_cell(config)
    yield cell
    cell.close()


@pytest.fixture(scope="package")
def connected_cell(config: CellConfig) -> Iterator[Cell]:
    """The connected cell that tests share."""
    with open_cell(config) as connected:
        yield connected


@pytest.fixture
def cell(connected_cell: Cell, opened: Opened, pace: float) -> Cell:
    """A connected cell, its arm at home and its fingers open."""
    arm, gripper, clock = connected_cell.arm, connected_cell.gripper, connected_cell.clock
    home = np.array(connected_cell.config.motion.home_q)
    while arm.moving:
        clock.sleep(PERIOD_S)
    state = arm.state()
    away = np.abs(state.q - home)
    if opened.real and (state.mode is not ArmMode.READY or away.max() > NEAR_HOME_RAD):
        pytest.exit(
            f"nothing is moved: the arm is {state.mode.value}, and joint {away.argmax() + 1} stands {away.max():.2f} "
            f"rad from home; take it within {NEAR_HOME_RAD} rad of home at the pendant",
            returncode=pytest.ExitCode.USAGE_ERROR,
        )
    if away.max() > 1e-3:
        arm.start_joints(home, 2.0 * pace, 4.0 * pace**2)
    gripper.start_width(OPEN_M, 20.0)
    clock.sleep(PERIOD_S)
    while arm.moving or gripper.state().busy:
        arm.kick()
        clock.sleep(PERIOD_S)
    return connected_cell
