"""Loopback addresses that no other run of the tests on this machine uses: the ports of a UR controller are fixed."""

from __future__ import annotations

import os

# The processes that a run starts have that of the run. Ids of processes that live at once differ.
_NETWORK = os.environ.setdefault(
    "ROBOTCELL_TEST_NETWORK", f"127.{1 + os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
)


def loopback(number: int) -> str:
    """The address of that number, 1 to 254."""
    return f"{_NETWORK}.{number}"
