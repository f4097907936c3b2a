"""Trapezoidal speed profiles, sampled at the controller's period. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array


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
