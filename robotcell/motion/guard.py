"""The guard that watches the arm while it moves, and the latch that remembers what it found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Protocol

import numpy as np

from robotcell.errors import CellError, DeviceFault, GuardTripped, UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.path_check import outside_box

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.plan import MotionPlan

# The measured arm may be this far from where a plan starts (settled position error of a UR5e is far below it).
_START_TOLERANCE_RAD = 0.02
# Measured speeds scatter about the commanded ones; a measured tcp overshoots its box by rounding and control error.
_SPEED_SLACK = 1.05
_BOX_SLACK_M = 0.005
# A time stamp may be ahead of the clock by what two clocks of one machine can differ.
_CLOCK_SLACK_S = 0.01


@dataclass(frozen=True)
class Stop:
    """A stop after which nothing moves until an operator asks for `recover`.

    Attributes:
        what: happened, in a sentence.
        at: when, UTC.
        q: joint angles (6,) [rad] that were measured when the arm stood; None where they could not be.
        job: number of the job that was stopped; None outside of jobs.
    """

    what: str
    at: datetime
    q: Array | None = None
    job: int | None = None


class StopStore(Protocol):
    """What keeps the stop of a cell for the next process. Each method raises StorageError."""

    def load(self) -> Stop | None:
        """The stop that stands; None if there is none."""
        ...

    def save(self, stop: Stop) -> None:
        """Keep a stop."""
        ...

    def clear(self) -> None:
        """No stop stands any more."""
        ...


class Latch:
    """Remembers a safety stop until an operator clears it. Every executor of a cell shares it.

    Args:
        store: keeps the stop beyond this process; None for a cell that ends with it.
    """

    def __init__(self, store: StopStore | None = None) -> None:
        self._store = store
        self._stop: Stop | None = None

    @property
    def stop(self) -> Stop | None:
        """The stop that stands; None if there is none."""
        return self._stop

    @property
    def violation(self) -> str | None:
        """What tripped it, or None."""
        return self._stop.what if self._stop else None

    def load(self) -> None:
        """Take over what an earlier process left.

        Raises:
            StorageError, ConfigError: its store cannot be read.
        """
        if self._store is not None and self._stop is None:
            self._stop = self._store.load()

    def trip(self, what: str) -> None:
        """Latch a violation, in memory: the arm still has to be stopped. The first one stands."""
        if self._stop is None:
            self._stop = Stop(what, datetime.now(timezone.utc))

    def keep(self, q: Array | None) -> str:
        """Have the store keep the stop, once the arm stands.

        Args:
            q: measured joint angles (6,) [rad]; None where they cannot be had.

        Returns:
            "", or why the store could not: the stop then ends with this process.
        """
        if self._stop is None:
            return ""
        self._stop = replace(self._stop, q=q)
        try:
            if self._store is not None:
                self._store.save(self._stop)
        except CellError as error:
            return (
                f"the stop could not be recorded ({error}), so other programs do not know of it: run robotcell recover "
                "before any of them"
            )
        return ""

    def clear(self) -> None:
        """Forget the stop. Only ever called because an operator asked for it.

        Raises:
            StorageError: the store still has it, and so has this latch.
        """
        if self._store is not None:
            self._store.clear()
        self._stop = None

    def check(self) -> None:
        """Raise GuardTripped if a violation is latched."""
        if self._stop is not None:
            raise GuardTripped(
                f"nothing moves after a safety stop ({self._stop.what}); look at the cell, then run robotcell recover"
            )


class Guard:
    """Watches the arm while it moves; what it finds is latched in the cell."""

    def __init__(self, config: CellConfig, latch: Latch) -> None:
        self._config = config
        self._latch = latch

    def check_start(self, state: ArmState, now: float, plan: MotionPlan) -> None:
        """Before a plan runs: nothing latched, the arm within its limits, and standing where the plan starts.

        Raises:
            GuardTripped: a violation is latched, or the arm's state is stale or beyond a limit.
            DeviceFault: the arm is not ready.
            UnsafeMotion: the arm stands elsewhere.
        """
        self._latch.check()
        self._check_state(state, now)
        off = float(np.abs(state.q - plan.q_start).max())
        if not off <= _START_TOLERANCE_RAD:
            raise UnsafeMotion(
                f"{plan.label}: a joint is {off:.3f} rad from the start of the plan: plan again from measured joints"
            )

    def check(self, state: ArmState, now: float, lowest_tip_m: float) -> None:
        """In every supervision period of a motion.

        Args:
            state: of the arm.
            now: on the cell's clock [s].
            lowest_tip_m: height above the table that the finger tips may go down to [m], see `CheckedPlan`.

        Raises:
            GuardTripped: a limit is exceeded or the state is stale; latched.
            DeviceFault: the controller stopped the arm; latched.
        """
        try:
            self._check_state(state, now)
            x, y, z = state.T_base_tcp[:3, 3]
            if outside_box(state.T_base_tcp[None, :3, 3], self._config, _BOX_SLACK_M, lowest_tip_m)[0]:
                raise _tripped(f"the tcp at x {x:.3f}, y {y:.3f}, z {z:.3f} m left its box")
        except (DeviceFault, GuardTripped) as error:
            self._latch.trip(str(error))
            raise

    def _check_state(self, state: ArmState, now: float) -> None:
        """Freshness, mode, force and speeds; a number that is not one fails every comparison."""
        limits = self._config.limits
        if state.mode is not ArmMode.READY:
            raise DeviceFault(
                f"the arm is in {state.mode.value}; clear the cause at the cell, then recover", device="arm"
            )
        age = now - state.t
        if not -_CLOCK_SLACK_S <= age <= limits.state_age_s:
            raise _tripped(f"the arm's state is {age:.2f} s old (limit {limits.state_age_s} s)")
        if not (np.isfinite(state.q).all() and np.isfinite(state.T_base_tcp).all()):
            raise _tripped("the arm reports a position that is not a number")
        force = float(np.linalg.norm(state.wrench[:3]))
        joint_speed = float(np.abs(state.qd).max())
        tool_speed = float(ur5e.tool_speed(state.q, state.qd, rg2.CLOSED_LENGTH_M))
        for value, limit, what in (
            (force, limits.force_n, "the tool feels {:.0f} N (limit {:.0f} N)"),
            (
                joint_speed,
                _SPEED_SLACK * limits.joint_speed_rad_s,
                "a joint turns at {:.2f} rad/s (limit {:.2f} rad/s)",
            ),
            (tool_speed, _SPEED_SLACK * limits.tool_speed_m_s, "the tool moves at {:.2f} m/s (limit {:.2f} m/s)"),
        ):
            if not value <= limit:
                raise _tripped(what.format(value, limit))


def _tripped(what: str) -> GuardTripped:
    return GuardTripped(f"{what}; the arm is stopped: look at the cell, then recover")
