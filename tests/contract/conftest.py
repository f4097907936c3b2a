"""The cells that the contract is stated for: one entry per backend, opened through the public interface only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from robotcell.cell import open_cell
from robotcell.config import load_config

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.cell import Cell
    from robotcell.config import CellConfig

BACKENDS = {
    "twin": {"backend.name": "twin", "backend.options.objects": 1},
}


@pytest.fixture(params=sorted(BACKENDS))
def config(request: pytest.FixtureRequest) -> CellConfig:
    """A cell file of each backend."""
    return load_config(None, BACKENDS[request.param])


@pytest.fixture
def closed_cell(config: CellConfig) -> Iterator[Cell]:
    """A cell that is not connected yet; closed whatever the test does."""
    cell = open_cell(config)
    yield cell
    cell.close()


@pytest.fixture
def cell(closed_cell: Cell) -> Iterator[Cell]:
    """A connected cell, its arm at home."""
    with closed_cell as connected:
        yield connected
