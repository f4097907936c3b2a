"""The arm's tests keep time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.robotcell.drivers.served_cell import supervising

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(autouse=True)
def _ahead() -> Iterator[None]:
    with supervising():
        yield
