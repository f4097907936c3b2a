"""The results of a benchmark as tables, for the terminal and for the page."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING

from policy.evaluation.metrics import PUBLISHED, Estimate, Metrics, Published

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from policy.evaluation.trials import TrialResult


@dataclass(frozen=True)
class Cell:
    """A figure as it is shown.

    Attributes:
        text: the figure.
        note: its interval, or what it is out of.
        shares: lower end, value and upper end (0 to 1) of a share; equal where there is no interval.
    """

    text: str
    note: str = ""
    shares: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Row:
    """A row; `published` tells figures of the paper from figures of this benchmark."""

    label: str
    cells: tuple[Cell, ...]
    published: bool = False


@dataclass(frozen=True)
class Table:
    """Rows under a header, whose first entry is the title of the labels."""

    header: tuple[str, ...]
    rows: tuple[Row, ...]


_NONE = Cell("-")


def results_table(suite: str, goal_oriented: bool, figures: Mapping[str, Metrics]) -> Table:
    """The figures of the policies side by side, and the published ones of the same suite below them."""
    goal = "goal grasp success" if goal_oriented else "grasp success"
    last = "motions" if goal_oriented else "action efficiency"
    header = ("policy", "completion", goal, last, "in the bin", "grasp success, all runs", "decision")
    rows = [_row(name, metrics, goal_oriented) for name, metrics in figures.items()]
    return Table(header, (*rows, *(_published_row(entry) for entry in PUBLISHED.get(suite, ()))))


def failures_table(figures: Mapping[str, Metrics]) -> Table:
    """How often each policy met each result that is no success."""
    kinds = sorted({kind for metrics in figures.values() for kind in metrics.failures})
    rows = [
        Row(name, tuple(Cell(str(metrics.failures.get(kind, 0))) for kind in kinds))
        for name, metrics in figures.items()
    ]
    return Table(("policy", *kinds), tuple(rows))


def scenes_table(results: Sequence[TrialResult]) -> Table:
    """Complete runs and motions by scene and policy."""
    policies = list(dict.fromkeys(result.policy for result in results))
    scenes = list(dict.fromkeys(result.scene for result in results))
    rows = []
    for scene in scenes:
        runs = [[r for r in results if (r.scene, r.policy) == (scene, policy)] for policy in policies]
        rows.append(Row(scene, tuple(_scene_cell(group) for group in runs)))
    return Table(("scene", *policies), tuple(rows))


def _scene_cell(runs: list[TrialResult]) -> Cell:
    if not runs:
        return _NONE
    completed = [run.actions for run in runs if run.completed]
    return Cell(f"{len(completed)} of {len(runs)}", f"{fmean(completed):.1f} motions" if completed else "")


def _row(name: str, metrics: Metrics, goal_oriented: bool) -> Row:
    cells = (
        _completion(metrics.completion, metrics.runs),
        _share(metrics.grasp_success),
        _number(metrics.motions) if goal_oriented else _share(metrics.efficiency),
        _completion(metrics.true_completion, metrics.runs),
        _share(metrics.grasp_success_overall),
        _NONE if metrics.decision_s is None else Cell(f"{1000 * metrics.decision_s:.0f} ms"),
    )
    return Row(name, cells)


def _published_row(entry: Published) -> Row:
    last = _NONE if entry.motions is None else Cell(f"{entry.motions:.2f}")
    if entry.efficiency is not None:
        last = _percent(entry.efficiency)
    cells = (_percent(entry.completion), _percent(entry.grasp_success), last, _NONE, _NONE, _NONE)
    return Row(f"{entry.method}, published", cells, published=True)


def _percent(value: float) -> Cell:
    return Cell(f"{value:.1f} %", shares=(value / 100, value / 100, value / 100))


def _completion(estimate: Estimate, runs: int) -> Cell:
    cell = _share(estimate)
    return Cell(cell.text, f"{round(estimate.value * runs)} of {runs}; {cell.note}", cell.shares)


def _share(estimate: Estimate | None) -> Cell:
    if estimate is None:
        return _NONE
    low, high = estimate.interval or (estimate.value, estimate.value)
    note = f"{100 * low:.0f} to {100 * high:.0f}" if estimate.interval else ""
    return Cell(f"{100 * estimate.value:.1f} %", note, (low, estimate.value, high))


def _number(estimate: Estimate | None) -> Cell:
    if estimate is None:
        return _NONE
    note = f"{estimate.interval[0]:.2f} to {estimate.interval[1]:.2f}" if estimate.interval else ""
    return Cell(f"{estimate.value:.2f}", note)
