"""How a served cell does: whether it keeps real time, and who is connected."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

# Of a connection in /proc/net/tcp: established.
_ESTABLISHED = "01"


@dataclass(frozen=True)
class Pace:
    """How a served cell kept time between two readings.

    Attributes:
        real_time_factor: simulated seconds per second.
        controller_hz: control periods of the arm per second.
        skipped: steps of the physics left out since the cell was started.
    """

    real_time_factor: float
    controller_hz: float
    skipped: int


def pace(before: tuple[np.void, np.void], now: tuple[np.void, np.void]) -> Pace:
    """The pace between two readings, each `ServedCell.state()` and `ServedCell.command()`."""
    (state_before, command_before), (state, command) = before, now
    seconds = max(float(state["wall"] - state_before["wall"]), 1e-9)
    return Pace(
        real_time_factor=float(state["t"] - state_before["t"]) / seconds,
        controller_hz=float(int(command["tick"]) - int(command_before["tick"])) / seconds,
        skipped=int(state["skipped"]),
    )


def connected_clients(endpoints: Mapping[str, str]) -> dict[str, int]:
    """How many connections each endpoint ("host:port", by name) has; empty where the system does not tell."""
    try:
        rows = [row.split() for row in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]]
    except OSError:
        return {}
    established = [row[1] for row in rows if row[3] == _ESTABLISHED]
    counts = {}
    for name, address in endpoints.items():
        host, _, port = address.rpartition(":")
        # The kernel writes the address in its own byte order, here that of a little-endian machine.
        local = f"{socket.inet_aton(socket.gethostbyname(host))[::-1].hex().upper()}:{int(port):04X}"
        counts[name] = established.count(local)
    return counts
