"""The twin's clock: waiting advances the physics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sim_twin.world.simulation import STEP_S

if TYPE_CHECKING:
    from sim_twin.world.world import World


class TwinClock:
    """The `Clock` of a world. Needs no connection of its own: it runs while any device of the cell is connected."""

    def __init__(self, world: World) -> None:
        self._world = world
        # The part of the waits so far that is shorter than a step.
        self._owed_s = 0.0

    def now(self) -> float:
        """Simulated seconds since the world was made."""
        return self._world.time_s

    def sleep(self, dt: float) -> None:
        """Advance the physics by `dt` [s], to the nearest step; what the rounding leaves goes to the next wait.

        Raises:
            ValueError: dt is negative or not finite.
            ConnectionLost: no device of the cell is connected.
        """
        if not math.isfinite(dt) or dt < 0:
            raise ValueError(f"sleep({dt}): the time to wait must be a finite number of seconds, 0 or more")
        self._owed_s += dt
        steps = max(0, round(self._owed_s / STEP_S))
        self._owed_s -= steps * STEP_S
        self._world.step(steps)
