"""The figures of the paper's tables over trials, with 95 % intervals; docs/explanation/benchmark.md defines them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import sqrt
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from policy.evaluation.trials import TrialResult

# The 97.5th percentile of the normal distribution.
_Z = 1.959964
# Fixed, so that the same trials give the same intervals.
BOOTSTRAP_SEED = 0
BOOTSTRAP_RESAMPLES = 2000


@dataclass(frozen=True)
class Estimate:
    """A figure; `interval` (95 %) is None where a single run does not give one."""

    value: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class Metrics:
    """The figures of one policy on one suite; those that no run gives are None.

    Attributes:
        runs: how many.
        completion: complete runs / runs.
        true_completion: the same by the simulator's truth.
        grasp_success: successful grasps / grasps of each completed run, their mean; a goal-oriented run grasps at
            its goal, and another object is no success.
        grasp_success_overall: successful grasps / grasps of all runs together.
        motions: pushes + grasps, mean over completed runs.
        efficiency: objects / (pushes + grasps) of each completed run for everything, their mean.
        failures: how often each result that is no success occurred.
        decision_s, simulated_s, wall_s: medians over runs.
    """

    runs: int
    completion: Estimate
    true_completion: Estimate
    grasp_success: Estimate | None
    grasp_success_overall: Estimate | None
    motions: Estimate | None
    efficiency: Estimate | None
    failures: dict[str, int]
    decision_s: float | None
    simulated_s: float
    wall_s: float


@dataclass(frozen=True)
class Published:
    """Figures of the paper, section "Evaluation": shares in percent; `motions` or `efficiency`, as its table has it."""

    method: str
    completion: float
    grasp_success: float
    motions: float | None = None
    efficiency: float | None = None


PUBLISHED: dict[str, tuple[Published, ...]] = {
    "random": (
        Published("GI", 96.7, 54.6, motions=5.37),
        Published("EPG", 97.8, 90.0, motions=4.82),
        Published("paper", 100.0, 94.4, motions=2.44),
        Published("grasping only", 98.1, 61.8, motions=2.69),
        Published("without two-stage training", 100.0, 84.7, motions=3.40),
    ),
    "challenging": (
        Published("GI", 95.0, 70.4, motions=4.33),
        Published("EPG", 99.0, 90.0, motions=2.77),
        Published("paper", 100.0, 93.6, motions=2.54),
    ),
    "agnostic": (
        Published("VPG", 82.7, 77.2, efficiency=60.1),
        Published("EPG", 95.1, 82.5, efficiency=56.7),
        Published("paper", 100.0, 90.3, efficiency=61.1),
    ),
}


def measure(results: Sequence[TrialResult]) -> Metrics:
    """The figures of one policy on one suite, of at least one trial."""
    completed = [result for result in results if result.completed]
    grasping = [result for result in completed if result.grasp_attempts]
    clearing = [result for result in completed if result.goal is None and result.actions]
    failures: Counter[str] = Counter()
    for result in results:
        failures.update(result.failures)
    decisions = [result.decision_s for result in results if result.decision_s is not None]
    return Metrics(
        runs=len(results),
        completion=share(len(completed), len(results)),
        true_completion=share(sum(result.true_completed for result in results), len(results)),
        grasp_success=mean([result.grasp_successes / result.grasp_attempts for result in grasping]),
        grasp_success_overall=ratio(
            [result.grasp_successes for result in results], [result.grasp_attempts for result in results]
        ),
        motions=mean([result.actions for result in completed]),
        efficiency=mean([result.objects / result.actions for result in clearing]),
        failures=dict(failures.most_common()),
        decision_s=median(decisions) if decisions else None,
        simulated_s=median(result.simulated_s for result in results),
        wall_s=median(result.wall_s for result in results),
    )


def share(successes: int, trials: int) -> Estimate:
    """A share with Wilson's score interval.

    Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
    """
    p, z2 = successes / trials, _Z * _Z / trials
    middle = (p + z2 / 2) / (1 + z2)
    half = _Z * sqrt(p * (1 - p) / trials + z2 / (4 * trials)) / (1 + z2)
    return Estimate(p, (max(0.0, middle - half), min(1.0, middle + half)))


def mean(values: Sequence[float]) -> Estimate | None:
    """The mean over runs, with the bootstrap's percentile interval."""
    return ratio(values, [1.0] * len(values))


def ratio(parts: Sequence[float], wholes: Sequence[float]) -> Estimate | None:
    """The sum of the parts over the sum of the wholes, runs (pairs) resampled for the interval; None for 0 / 0."""
    whole = sum(wholes)
    if not whole:
        return None
    value = sum(parts) / whole
    if len(parts) < 2:
        return Estimate(value, None)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    drawn = rng.integers(len(parts), size=(BOOTSTRAP_RESAMPLES, len(parts)))
    part_sums, whole_sums = np.asarray(parts)[drawn].sum(axis=1), np.asarray(wholes)[drawn].sum(axis=1)
    known = whole_sums > 0
    low, high = np.percentile(part_sums[known] / whole_sums[known], (2.5, 97.5))
    return Estimate(value, (float(low), float(high)))
