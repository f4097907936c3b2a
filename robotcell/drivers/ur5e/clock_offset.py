"""When a packet of the controller was measured, on the clock of this computer."""

from __future__ import annotations

import time
from collections import deque

# The offset between two clocks is the smallest that was seen in this and the previous period of so many seconds: it
# drifts by less than a millisecond in that time.
_PERIOD_S = 10.0


class ClockOffset:
    """From the controller's time stamps to time.monotonic(): a packet is never older than its fastest sibling says."""

    def __init__(self) -> None:
        self._periods: deque[tuple[float, float]] = deque(maxlen=2)

    def to_local(self, stamp: float) -> float:
        """Time.monotonic() [s] of the controller's `stamp` [s], of a packet that has just come in."""
        now = time.monotonic()
        offset = now - stamp
        if not self._periods or now - self._periods[-1][0] > _PERIOD_S:
            self._periods.append((now, offset))
        elif offset < self._periods[-1][1]:
            self._periods[-1] = (self._periods[-1][0], offset)
        return stamp + min(offset for _, offset in self._periods)
