"""The wall clock of a cell with real devices."""

from __future__ import annotations

import math
import time

from robotcell.interfaces import Clock


class WallClock(Clock):
    """Seconds of `time.monotonic`."""

    def now(self) -> float:
        """Seconds since an arbitrary start."""
        return time.monotonic()

    def sleep(self, dt: float) -> None:
        """Wait `dt` [s].

        Raises:
            ValueError: dt is negative or not finite.
        """
        if not math.isfinite(dt) or dt < 0:
            raise ValueError(f"sleep({dt}): the time to wait must be a finite number of seconds, 0 or more")
        time.sleep(dt)
