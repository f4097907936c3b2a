"""Speed profiles along a line and along a path of joint angles, sampled at the controller's period. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline

from robotcell.geometry import ur5e
from sim_twin.devices.arm_limits import ROTATION_LEVER_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.geometry.rounded_path import RoundedPath
    from robotcell.geometry.transforms import Array

# Universal Robots publishes no limit of the jerk. This one was tried on an arm of the size of a UR5
# (github.com/moveit/moveit_resources, pull request 201).
MAX_JOINT_JERK_RAD_S3 = 300.0
# Share of the acceleration that a bend may take: the rest is there to brake and to speed up in it.
_BEND_SHARE = 0.8
# Enough for up to 7.5 rad/s^2. Near a singularity a line asks for so much more that no average helps: it is kept.
_LONGEST_AVERAGE_S = 0.05
# Cosine of the angle between neighbouring chords of a path that turns back.
_TURNS_BACK = 0.7
# Accelerations that exceed a limit by no more than this share of it are taken for rounding.
_EXACT = 1.05
# Rates of change of the path below this count as none.
_FLAT = 1e-9


def trapezoid(distance: float, speed: float, acceleration: float, period: float) -> Array:
    """Positions along a path that starts and ends at rest, as fast as the limits allow.

    The speed rises at `acceleration` to `speed`, stays there and falls again; a short path never reaches `speed`
    (a triangle). Between neighbouring samples neither limit is exceeded.

    Args:
        distance: length of the path, >= 0, in any unit.
        speed: > 0, unit/s.
        acceleration: > 0, unit/s^2.
        period: time between samples [s].

    Returns:
        (N,) positions after 1, 2, ... N periods; the last one is `distance`. Empty when there is nowhere to go.
    """
    if distance <= 0:
        return np.empty(0)
    profile = Trapezoid(distance, speed, acceleration)
    t = np.arange(1, math.ceil(profile.duration / period) + 1) * period
    s = profile.position(np.asarray(t, dtype=np.float64))
    s[-1] = distance
    return s


@dataclass(frozen=True)
class Trapezoid:
    """The profile of `trapezoid` at any time; the arguments are the same, and `distance` is above 0."""

    distance: float
    speed: float
    acceleration: float

    @property
    def ramp(self) -> float:
        """How long the speed rises [s]."""
        return min(self.speed / self.acceleration, math.sqrt(self.distance / self.acceleration))

    @property
    def duration(self) -> float:
        """How long the motion takes [s]."""
        return self.ramp + self.distance / (self.acceleration * self.ramp)

    def position(self, t: Array | float) -> Array:
        """Positions at times [s] from 0 to `duration`, in the shape of `t`."""
        ramp, duration = self.ramp, self.duration
        cruise_speed = self.acceleration * ramp
        rising = 0.5 * self.acceleration * np.minimum(t, ramp) ** 2
        cruising = cruise_speed * np.clip(t - ramp, 0.0, duration - 2 * ramp)
        falling = np.clip(t - (duration - ramp), 0.0, ramp)
        s = rising + cruising + falling * (cruise_speed - 0.5 * self.acceleration * falling)
        return np.asarray(np.minimum(s, self.distance))


def slow_down(path: Array, index: int, deceleration: float, period: float) -> Array:
    """The rest of a sampled path when it is left by braking: the same way, ever slower, to a standstill.

    Args:
        path: (N, D) positions, one per period.
        index: the sample that was reached last.
        deceleration: of the coordinate that moves fastest, unit/s^2.
        period: time between samples [s].

    Returns:
        (M, D) positions after 1, 2, ... M periods; empty when nothing moves.
    """
    if not 0 <= index < len(path) - 1:
        return path[len(path) :]
    speed = float(np.abs(path[index + 1] - path[index]).max()) / period
    duration = speed / deceleration
    t = np.arange(1, math.ceil(duration / period) + 1) * period
    t = np.minimum(t, duration)
    # The path is followed at a rate that falls linearly from 1 to 0.
    progress = index + (t - 0.5 * t**2 / duration) / period if duration > 0 else np.empty(0)
    progress = np.minimum(progress, len(path) - 1)
    low = np.minimum(progress.astype(int), len(path) - 2)
    rest = (progress - low)[:, None]
    return np.asarray(path[low] * (1 - rest) + path[low + 1] * rest)


@dataclass(frozen=True)
class LegLimits:
    """How fast one leg of a path may be driven.

    Attributes:
        straight: the tool moves on a line, and the limits are its own [m/s, m/s^2]; else they are those of the leading
            joint [rad/s, rad/s^2].
        speed: > 0.
        acceleration: > 0.
    """

    straight: bool
    speed: float
    acceleration: float


@dataclass(frozen=True)
class Trajectory:
    """A path in time.

    Attributes:
        q: (N, 6) joint angles [rad] after 1, 2, ... N periods.
        leg: (N,) the leg of the path that each belongs to.
    """

    q: Array
    leg: npt.NDArray[np.int64]


def time_path(
    path: RoundedPath, limits: Sequence[LegLimits], T_flange_tcp: Array, period: float, *, stops: bool = True
) -> Trajectory:
    """Drive a path from rest as fast as the limits of its legs allow; in a corner those of both legs hold.

    The speed along the path is the highest from which every limit ahead can still be met (a forward and a backward
    pass, as in time-optimal path parameterisation). The samples are then averaged over at most 50 ms, which bounds the
    jerk of every joint by `MAX_JOINT_JERK_RAD_S3` (at accelerations of up to 7.5 rad/s^2), raises neither speed nor
    acceleration, and moves a corner by less than a millimetre.

    Args:
        path: its samples; neighbours that differ by next to nothing count as one.
        limits: of each leg.
        T_flange_tcp: (4, 4) the tool.
        period: time between samples [s].
        stops: the motion comes to rest at the end of the path; one that breaks off there does not.
    """
    keep = np.concatenate([[True], np.abs(np.diff(path.q, axis=0)).max(axis=1) > _FLAT])
    q, leg, other = path.q[keep], path.leg[keep], path.other[keep]
    if len(q) < 2:
        return Trajectory(np.empty((0, 6)), np.empty(0, np.int64))
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    slope = np.gradient(q, s, axis=0)
    cap, rows, bends = _rows(q, s, slope, leg, other, limits, T_flange_tcp)
    x = _squared_speeds(s, cap, rows, bends, stops=stops)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (np.sqrt(x[:-1]) + np.sqrt(x[1:])))])
    line = CubicHermiteSpline(s, q, slope)
    trajectory = _sampled(s, x, t, line, leg, period, stops=stops)
    # Between two samples of the path a sharp corner may bend more than at either: there all of it is driven slower.
    excess = _excess(q[0], trajectory, limits, T_flange_tcp, period)
    if excess > _EXACT:
        trajectory = _sampled(s, x / excess, t * math.sqrt(excess), line, leg, period, stops=stops)
    return trajectory


def _sampled(
    s: Array, x: Array, t: Array, line: CubicHermiteSpline, leg: npt.NDArray[np.int64], period: float, *, stops: bool
) -> Trajectory:
    """A path over s (N,) with squared speeds x (N,), passed at times t (N,), in periods."""
    at = np.minimum(np.arange(1, math.ceil(t[-1] / period - 1e-9) + 1) * period, t[-1])
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    speed, dt = np.sqrt(x[k]), at - t[k]
    rate = (x[k + 1] - x[k]) / (2 * (s[k + 1] - s[k]))
    q = line(np.minimum(s[k] + speed * dt + 0.5 * rate * dt**2, s[-1]))
    q[-1] = line(s[-1])
    return _smoothed(line(s[0]), q, leg[k], period, stops=stops)


def _excess(
    start: Array, trajectory: Trajectory, limits: Sequence[LegLimits], T_flange_tcp: Array, period: float
) -> float:
    """By how many times the accelerations of a trajectory exceed the limits of its legs, at least 1."""
    q = np.vstack([start, start, trajectory.q])
    joints = np.abs(np.diff(q, n=2, axis=0)).max(axis=1)
    tool = np.linalg.norm(np.diff((ur5e.forward(q) @ T_flange_tcp)[:, :3, 3], n=2, axis=0), axis=1)
    worst = 1.0
    for i, limit in enumerate(limits):
        here = trajectory.leg == i
        felt = (tool if limit.straight else joints)[here]
        worst = max(worst, float(felt.max(initial=0.0)) / (limit.acceleration * period**2))
    return worst


def _rows(
    q: Array,
    s: Array,
    slope: Array,
    leg: npt.NDArray[np.int64],
    other: npt.NDArray[np.int64],
    limits: Sequence[LegLimits],
    T_flange_tcp: Array,
) -> tuple[Array, Array, Array]:
    """The limits at each sample, for a path q (N, 6) over s (N,), as limits of ds/dt and d2s/dt2.

    Returns:
        (N,) the highest (ds/dt)^2; and (N, 7) `rows` and `bends`, of the six joints and the tool, with which
        |d2s/dt2 + bends (ds/dt)^2| <= rows.
    """
    bend = np.gradient(slope, s, axis=0)
    T = ur5e.forward(q) @ T_flange_tcp
    way = np.gradient(T[:, :3, 3], s, axis=0)
    curve = np.gradient(way, s, axis=0)
    chord = np.linalg.norm(np.diff(T[:, :3, :3], axis=0), axis=(1, 2))
    turned = np.concatenate([[0.0], np.cumsum(2 * np.arcsin(np.minimum(chord / math.sqrt(8), 1.0)))])
    moved = np.maximum(np.linalg.norm(way, axis=1), ROTATION_LEVER_M * np.gradient(turned, s))
    along = np.einsum("ij,ij->i", way, curve) / np.maximum(np.linalg.norm(way, axis=1), _FLAT)
    across = np.sqrt(np.maximum((curve**2).sum(axis=1) - along**2, 0.0))
    cap = np.full(len(s), np.inf)
    rows, bends = np.full((len(s), 7), np.inf), np.zeros((len(s), 7))
    rates = np.column_stack([np.abs(slope), moved])
    bends[:, :6] = np.sign(slope) * bend
    bends[:, 6] = along
    bends /= np.maximum(rates, _FLAT)
    for i, limit in enumerate(limits):
        here = (leg == i) | (other == i)
        # A slope at the rim of a corner is taken from samples on both sides.
        here |= np.concatenate([here[1:], [False]]) | np.concatenate([[False], here[:-1]])
        if limit.straight:
            cap[here] = np.minimum(cap[here], (limit.speed / np.maximum(moved[here], _FLAT)) ** 2)
            sideways = np.maximum(np.hypot(across[here], along[here]), _FLAT)
            cap[here] = np.minimum(cap[here], _BEND_SHARE * limit.acceleration / sideways)
            left = np.sqrt(1 - np.minimum(across[here] * cap[here] / limit.acceleration, _BEND_SHARE) ** 2)
            rows[here, 6] = np.minimum(rows[here, 6], left * limit.acceleration / np.maximum(moved[here], _FLAT))
        else:
            joints = np.abs(slope[here])
            cap[here] = np.minimum(cap[here], (limit.speed / joints.max(axis=1)) ** 2)
            sideways = np.maximum(np.abs(bend[here]).max(axis=1), _FLAT)
            cap[here] = np.minimum(cap[here], _BEND_SHARE * limit.acceleration / sideways)
            rows[here, :6] = np.minimum(rows[here, :6], limit.acceleration / np.maximum(joints, _FLAT))
    bends[np.isinf(rows)] = 0.0
    # Where the path turns back, the arm comes to rest; of neighbours at one of them.
    chords = np.diff(q, axis=0) / np.diff(s)[:, None]
    sharp = np.concatenate([[False], np.einsum("ij,ij->i", chords[:-1], chords[1:]) < _TURNS_BACK, [False]])
    sharp[1:] &= ~sharp[:-1]
    cap[sharp] = 0.0
    return cap, rows, bends


def _squared_speeds(s: Array, cap: Array, rows: Array, bends: Array, *, stops: bool) -> Array:
    """The highest (ds/dt)^2 (N,) from rest within the limits of `_rows`."""
    # Plain numbers: for rows of seven an array costs several times as much.
    x, limits, curves = cap.tolist(), rows.tolist(), bends.tolist()
    x[0] = 0.0
    if stops:
        x[-1] = 0.0
    twice = (2 * np.diff(s)).tolist()

    def rate(j: int, square: float, sign: float) -> float:
        """The highest d2s/dt2 (with sign -1 the highest braking) between the samples j and j + 1."""
        here = (limit - sign * curve * square for limit, curve in zip(limits[j], curves[j], strict=True))
        there = (limit - sign * curve * square for limit, curve in zip(limits[j + 1], curves[j + 1], strict=True))
        return max(0.0, float(min(*here, *there)))

    for j in range(len(x) - 2, 0, -1):
        x[j] = min(x[j], x[j + 1] + twice[j] * rate(j, min(x[j + 1], x[j]), -1.0))
    for j in range(len(x) - 1):
        x[j + 1] = min(x[j + 1], x[j] + twice[j] * rate(j, x[j], 1.0))
    return np.array(x)


def _smoothed(start: Array, q: Array, leg: npt.NDArray[np.int64], period: float, *, stops: bool) -> Trajectory:
    """Average q (N, 6) after `start` (6,) until no joint jerks too much; at rest before, and after if it stops."""
    before, after = np.repeat(start[None], 2, axis=0), np.repeat(q[-1:], 2 if stops else 0, axis=0)
    acceleration = np.diff(np.vstack([before, q, after]), n=2, axis=0) / period**2
    longest = math.floor(_LONGEST_AVERAGE_S / period)
    window = min(math.ceil(2 * float(np.abs(acceleration).max()) / (MAX_JOINT_JERK_RAD_S3 * period)), longest)
    if window < 2:
        return Trajectory(q, leg)
    longer = np.vstack(
        [np.repeat(start[None], window, axis=0), q, np.repeat(q[-1:], window - 1 if stops else 0, axis=0)]
    )
    sums = np.cumsum(longer - start, axis=0)
    averages = start + (sums[window:] - sums[:-window]) / window
    if stops:
        averages[-1] = q[-1]
    late = np.clip(np.arange(len(averages)) - window // 2, 0, len(leg) - 1)
    return Trajectory(averages, leg[late])
