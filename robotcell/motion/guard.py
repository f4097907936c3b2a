"""The guard that watches the arm while it moves, and the latch that remembers what it found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import DeviceFault, GuardTripped, UnsafeMotion
from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.path_check import outside_box

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.motion.plan import MotionPlan

# The measured arm may be this far from where a plan starts (settled position error of a UR5e is far below it).
_START_TOLERANCE_RAD = 0.02
# Measured speeds scatter about the commanded ones; a measured tcp overshoots its box by rounding and control error.
_SPEED_SLACK = 1.05
_BOX_SLACK_M = 0.005
# A time stamp may be ahead of the clock by what two clocks of one machine can differ.
_CLOCK_SLACK_S = 0.01


class Latch:
    """Remembers a safety violation until an operator clears it. Every executor of a cell shares it."""

    def __init__(self) -> None:
        self._violation: str | None = None

    @property
    def violation(self) -> str | None:
        """What tripped it, or None."""
        return self._violation

    def trip(self, what: str) -> None:
        """Latch a violation; the first one stands."""
        self._violation = self._violation or what

    def clear(self) -> None:
        """Forget the violation. Only ever called because an operator asked for it."""
        self._violation = None

    def check(self) -> None:
        """Raise GuardTripped if a violation is latched."""
        if self._violation:
            raise GuardTripped(f"nothing moves after a safety stop ({self._violation}); look at the cell, then recover")


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
