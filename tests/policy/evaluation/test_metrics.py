from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.evaluation.metrics import BOOTSTRAP_RESAMPLES, PUBLISHED, mean, measure, ratio, share
from tests.policy.evaluation.examples import result, run


def test_the_figures_of_goal_oriented_runs_are_those_of_the_paper():
    runs = [
        run(1, decision_s=0.1, simulated_s=10.0),
        run(2, pushes=1, failures={"missed": 1}, decision_s=0.2, simulated_s=20.0),
        run(4, pushes=2, failures={"collided": 2, "missed": 1}, decision_s=0.4, simulated_s=60.0),
        run(10, completed=False, failures={"missed": 10}, simulated_s=90.0),
    ]
    metrics = measure(runs)
    assert metrics.runs == 4
    assert metrics.completion.value == 3 / 4
    # Each completed run has its own share: 1/1, 1/2 and 1/4.
    assert metrics.grasp_success is not None
    assert metrics.grasp_success.value == pytest.approx((1 + 1 / 2 + 1 / 4) / 3)
    assert metrics.grasp_success_overall is not None
    assert metrics.grasp_success_overall.value == pytest.approx(3 / 17)
    assert metrics.motions is not None
    assert metrics.motions.value == pytest.approx((1 + 3 + 6) / 3)
    assert metrics.efficiency is None
    assert metrics.failures == {"missed": 12, "collided": 2}
    assert (metrics.decision_s, metrics.simulated_s) == (0.2, 40.0)


def test_the_figures_of_goal_agnostic_runs_are_those_of_the_paper():
    def clear(objects, attempts, pushes, *, completed=True):
        return result(
            goal=None,
            objects=objects,
            completed=completed,
            true_completed=False,
            actions=attempts + pushes,
            grasp_attempts=attempts,
            grasp_successes=objects if completed else 0,
        )

    metrics = measure([clear(5, 5, 0), clear(5, 8, 2), clear(5, 10, 0, completed=False)])
    assert metrics.efficiency is not None
    assert metrics.efficiency.value == pytest.approx((5 / 5 + 5 / 10) / 2)
    assert metrics.grasp_success is not None
    assert metrics.grasp_success.value == pytest.approx((5 / 5 + 5 / 8) / 2)
    assert metrics.true_completion.value == 0


def test_what_no_run_gives_is_no_figure():
    metrics = measure([result(reason="no red object is seen")])
    assert metrics.completion.value == 0
    assert (metrics.grasp_success, metrics.grasp_success_overall, metrics.motions) == (None, None, None)
    assert metrics.decision_s is None
    # A table that was empty from the start.
    assert measure([result(goal=None, completed=True)]).efficiency is None


def test_wilson_s_interval_is_the_textbook_s():
    # Brown, Cai, DasGupta (2001) and any table: 8 of 10 is 0.490 to 0.943.
    low, high = share(8, 10).interval or (0, 0)
    assert (low, high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))
    assert share(30, 30).interval == (pytest.approx(0.8865, abs=1e-4), pytest.approx(1))


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_a_share_lies_in_its_interval_and_more_trials_narrow_it(pair):
    k, n = pair
    estimate, finer = share(k, n), share(4 * k, 4 * n)
    assert estimate.interval is not None
    assert finer.interval is not None
    low, high = estimate.interval
    assert 0 <= low <= estimate.value + 1e-12
    assert estimate.value - 1e-12 <= high <= 1
    assert finer.interval[1] - finer.interval[0] < high - low
    mirrored = share(n - k, n).interval
    assert mirrored == (pytest.approx(1 - high), pytest.approx(1 - low))


@given(st.lists(st.floats(0, 50), min_size=2, max_size=40))
def test_a_mean_lies_among_its_runs_and_so_does_its_interval(values):
    estimate = mean(values)
    assert estimate is not None
    assert estimate.interval is not None
    low, high = estimate.interval
    assert min(values) - 1e-9 <= low <= high <= max(values) + 1e-9
    assert min(values) - 1e-9 <= estimate.value <= max(values) + 1e-9
    assert mean(values) == estimate


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)).map(lambda p: (min(p), max(p))), max_size=20))
def test_a_ratio_of_counts_is_a_share_or_none(pairs):
    estimate = ratio([k for k, _ in pairs], [n for _, n in pairs])
    if not any(n for _, n in pairs):
        assert estimate is None
    else:
        assert estimate is not None
        low, high = estimate.interval or (estimate.value, estimate.value)
        assert 0 <= low <= high <= 1
        assert 0 <= estimate.value <= 1


def test_one_run_gives_no_interval():
    estimate = mean([2.5])
    assert estimate is not None
    assert (estimate.value, estimate.interval) == (2.5, None)
    assert mean([]) is None


def test_the_bootstrap_covers_what_it_should():
    # The mean of 100 coins has a standard error of 0.05.
    low, high = (mean([0.0, 1.0] * 50) or share(1, 1)).interval or (0, 0)
    assert (low, high) == (pytest.approx(0.402, abs=0.015), pytest.approx(0.598, abs=0.015))
    assert BOOTSTRAP_RESAMPLES >= 1000


def test_the_paper_published_motions_for_goals_and_efficiency_for_all():
    for suite, entries in PUBLISHED.items():
        assert all((entry.efficiency is not None) == (suite == "agnostic") for entry in entries)
        assert all((entry.motions is None) == (suite == "agnostic") for entry in entries)
