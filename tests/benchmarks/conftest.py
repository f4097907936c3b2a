"""Where nothing is measured, each benchmark runs once on its smallest input: that shows that it still runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

# Parts of the names of the cases that only their figures are for.
_LARGE = ("30 objects", "[30]", "1280x720", "-200]")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out large cases unless benchmarks are measured (`make bench`)."""
    if config.getoption("benchmark_enable") or not config.getoption("benchmark_disable"):
        return
    here = "tests/benchmarks/"
    large = [item for item in items if item.nodeid.startswith(here) and any(part in item.name for part in _LARGE)]
    if large:
        config.hook.pytest_deselected(items=large)
        items[:] = [item for item in items if item not in large]
