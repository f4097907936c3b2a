"""The guard that watches the arm while it moves, and the latch that remembers what it found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np

from robotcell.config.surroundings import obstacles
from robotcell.errors import CellError, DeviceFault, GuardTripped, UnsafeMotion
from robotcell.geometry import bodies, rg2, ur5e
from robotcell.geometry.transforms import cross
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.course import Course, Phase

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.motion.plan import MotionPlan

# The measured arm may be this far from where a plan starts (settled position error of a UR5e is far below it).
_START_TOLERANCE_RAD = 0.02
# Measured speeds scatter about the commanded ones; a measured tcp overshoots its box by rounding and control error.
_SPEED_SLACK = 1.05
_BOX_SLACK_M = 0.005
# From a measurement to a brake that acts: the age of a state, a period of the executor, the way of the command. Then
# the tool brakes at 10 m/s^2 (what the driver passes to stopl), here 0.5 m from the joint that turns fastest. With
# both, the served arm stands within 52 ms of a stop at 0.1 m/s (docs/explanation/what-was-verified.md).
_REACTION_S = 0.03
_BRAKES_RAD_S2 = 20.0
# Where nothing is to be touched, a force over this share of its limit for so long is no noise but something that gives
# way slowly. Assumed; free motions of the twin show none.
_PRESSES_SHARE, _PRESSES_S = 0.5, 0.3
# A motion that begins pressed against something, after a contact ended the one before, may press so much more until it
# has left it, for at most so long. Assumed.
_LEAVING_N, _LEAVES_S = 20.0, 1.0
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
    """Watches the arm while it moves; what it finds is latched in the cell.

    Args:
        config: of the cell.
        latch: of the cell.
    """

    def __init__(self, config: CellConfig, latch: Latch) -> None:
        self._config = config
        self._latch = latch
        limits, table = config.limits, config.table.height_m
        # The box of the tcp, base frame.
        self._box = np.array([limits.x, limits.y, limits.z]).T + np.array([0.0, 0.0, table])
        self._obstacles = obstacles(config)
        # Their lowest and highest corners (K, 1, 3).
        corners = [box.corners() for box in self._obstacles]
        self._low, self._high = (np.array([pair[i] for pair in corners])[:, None] for i in (0, 1))
        self._force_limits = {
            Phase.FREE: min(limits.free_force_n, limits.force_n),
            Phase.CARRY: limits.force_n,
            Phase.GUARDED: limits.force_n,
            Phase.GRIP: limits.grip_force_n,
        }
        self._course: Course | None = None
        # Of this course: how far the tcp may be outside its box [m], which obstacles were entered at its start, the
        # force that it may press with until it has left what it started against, and since when it has pressed.
        self._outside_m = 0.0
        self._entered = np.zeros(len(self._obstacles), bool)
        self._leaving_n = 0.0
        self._pressing_since: float | None = None

    def check_start(self, state: ArmState, now: float, plan: MotionPlan) -> None:
        """Before a plan runs: nothing latched, the arm within its limits, and standing where the plan starts.

        Raises:
            GuardTripped: a violation is latched, or the arm's state is stale or beyond a limit.
            DeviceFault: the arm is not ready.
            UnsafeMotion: the arm stands elsewhere.
        """
        self._latch.check()
        self._check_fresh(state, now)
        self._check_force(_force(state), self._config.limits.grip_force_n, "before it moves")
        self._check_speeds(state, ur5e.link_frames(state.q))
        off = float(np.abs(state.q - plan.q_start).max())
        if not off <= _START_TOLERANCE_RAD:
            raise UnsafeMotion(
                f"{plan.label}: a joint is {off:.3f} rad from the start of the plan: plan again from measured joints"
            )

    def begin(self, course: Course, state: ArmState) -> None:
        """What is watched from now on; `state` is the arm's at its start.

        Where the arm stands is a fact: it may leave a place outside its box, a keep-out or a contact, not go deeper.
        """
        frames = ur5e.link_frames(state.q)
        self._course = course
        self._outside_m = max(_BOX_SLACK_M, self._outside(state.T_base_tcp[:3, 3], course))
        self._entered = self._enters(frames, course.load_m)
        self._leaving_n = _force(state) + _LEAVING_N
        self._pressing_since = None

    def check(self, state: ArmState, now: float) -> None:
        """In every supervision period of what was begun.

        Args:
            state: of the arm.
            now: on the cell's clock [s].

        Raises:
            GuardTripped: a limit is exceeded, or would be before the arm stands; or the state is stale. Latched.
            DeviceFault: the controller stopped the arm; latched.
        """
        try:
            self._check(state, now)
        except (DeviceFault, GuardTripped) as error:
            self._latch.trip(str(error))
            raise

    def _check(self, state: ArmState, now: float) -> None:
        course = self._course
        if course is None:
            raise GuardTripped("nothing was begun that could be watched")
        self._check_fresh(state, now)
        self._check_contact(_force(state), now, course)
        leading = float(np.abs(state.qd).max())
        q_stands = state.q + state.qd * (_REACTION_S + leading / (2 * _BRAKES_RAD_S2))
        frames = ur5e.link_frames(np.stack([state.q, q_stands]))
        self._check_speeds(state, frames[0])
        off = course.distance(state.q)
        if not off <= course.off_rad:
            raise _tripped(f"step {course.label!r}: a joint is {off:.2f} rad from the path that was checked")
        tcp = state.T_base_tcp[:3, 3] + _tcp(frames[1]) - _tcp(frames[0])
        if not self._outside(tcp, course) <= self._outside_m:
            x, y, z = tcp
            raise _tripped(f"the tcp would stand at x {x:.3f}, y {y:.3f}, z {z:.3f} m, outside its box")
        entered = self._enters(frames[1], course.load_m)
        self._entered &= entered
        if (entered & ~self._entered).any():
            name = self._obstacles[int((entered & ~self._entered).argmax())].name
            raise _tripped(f"the arm, the gripper or its load would stand in the keep-out {name!r}")

    def _outside(self, tcp: Array, course: Course) -> float:
        """How far a tcp (3,) [m] is outside its box; a lower tip than the box's lets it reach so far."""
        low, high = self._box
        floor = min(low[2], course.lowest_tip_m + self._config.table.height_m)
        return float(max((low[:2] - tcp[:2]).max(), floor - tcp[2], (tcp - high).max()))

    def _enters(self, frames: Array, load_m: float) -> npt.NDArray[np.bool_]:
        """Which obstacles (K,) arm, gripper or load are in, of link frames (7, 4, 4)."""
        spheres, held = bodies.SPHERES, frames[bodies.SPHERES.link]
        centers = np.einsum("nij,nj->ni", held[:, :3, :3], spheres.center) + held[:, :3, 3]
        inside = bodies.box_distance(self._low, self._high, centers) < spheres.radius
        tool = _tool_points(load_m) @ frames[6, :3, :3].T + frames[6, :3, 3]
        touched = ((tool > self._low) & (tool < self._high)).all(axis=-1)
        # The base stands where it stands.
        return np.asarray(inside[:, spheres.group > 0].any(axis=1) | touched.any(axis=1))

    def _check_fresh(self, state: ArmState, now: float) -> None:
        """Mode and freshness; a number that is not one fails every comparison."""
        limit = self._config.limits.state_age_s
        if state.mode is not ArmMode.READY:
            raise DeviceFault(
                f"the arm is in {state.mode.value}; clear the cause at the cell, then run robotcell recover",
                device="arm",
            )
        age = now - state.t
        if not -_CLOCK_SLACK_S <= age <= limit:
            raise _tripped(f"the arm's state is {age:.2f} s old (limit {limit} s)")
        if not (np.isfinite(state.q).all() and np.isfinite(state.T_base_tcp).all()):
            raise _tripped("the arm reports a position that is not a number")

    def _check_contact(self, force: float, now: float, course: Course) -> None:
        """The force on the tool [N]: an impact at once, and where nothing is to be touched a slow rise as well."""
        limit = self._force_limits[course.phase]
        if course.phase is not Phase.FREE:
            self._check_force(force, limit, course.phase.value)
            return
        if force <= limit * _PRESSES_SHARE:
            # It has left what it started against, if anything.
            self._leaving_n, self._pressing_since = 0.0, None
            return
        most = min(max(limit, self._leaving_n), self._force_limits[Phase.GRIP])
        self._check_force(force, most, course.phase.value)
        since = self._pressing_since = now if self._pressing_since is None else self._pressing_since
        if now - since > (_LEAVES_S if self._leaving_n else _PRESSES_S):
            raise _tripped(
                f"the tool has felt {force:.0f} N for {now - since:.1f} s where nothing is to be touched "
                f"({course.phase.value}, step {course.label!r})"
            )

    def _check_force(self, force: float, limit: float, when: str) -> None:
        if not force <= limit:
            raise _tripped(f"the tool feels {force:.0f} N (limit {limit:.0f} N, {when})")

    def _check_speeds(self, state: ArmState, frames: Array) -> None:
        limits = self._config.limits
        arms = _tcp(frames) - frames[:6, :3, 3]
        tool_speed = float(np.linalg.norm(state.qd @ cross(frames[:6, :3, 2], arms)))
        joint_speed = float(np.abs(state.qd).max())
        for value, limit, what, unit in (
            (joint_speed, limits.joint_speed_rad_s, "a joint turns", "rad/s"),
            (tool_speed, limits.tool_speed_m_s, "the tool moves", "m/s"),
        ):
            if not value <= _SPEED_SLACK * limit:
                raise _tripped(f"{what} at {value:.2f} {unit} (limit {limit:.2f} {unit})")


def _force(state: ArmState) -> float:
    return float(np.linalg.norm(state.wrench[:3]))


def _tcp(frames: Array) -> Array:
    """(3,) [m] of link frames (7, 4, 4)."""
    return np.asarray(frames[6, :3, 3] + rg2.CLOSED_LENGTH_M * frames[6, :3, 2])


@lru_cache(maxsize=32)
def _tool_points(load_m: float) -> Array:
    """Points (N, 3) [m] of the flange that stand for the fingers, opened any way, and for a load below them."""
    half = rg2.MAX_WIDTH_M / 2
    x, z = np.linspace(-half, half, 5), np.linspace(rg2.PALM_M, rg2.CLOSED_LENGTH_M + load_m, 5)
    return np.stack(np.meshgrid(x, [0.0], z, indexing="ij"), axis=-1).reshape(-1, 3)


def _tripped(what: str) -> GuardTripped:
    return GuardTripped(f"{what}; the arm is stopped: look at the cell, then run robotcell recover")
