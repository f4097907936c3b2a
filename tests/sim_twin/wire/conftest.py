"""Processes of a served cell share memory."""

from __future__ import annotations

from multiprocessing import resource_tracker

import pytest


@pytest.fixture(scope="package", autouse=True)
def tracker() -> None:
    """The one process that multiprocessing keeps for shared memory is there before a test, and is none of its leaks."""
    resource_tracker.ensure_running()
