"""How often jobs succeed in the twin: `make bench-picks`, or `python -m tests.benchmarks.picks --seeds 5`.

Each row is a request with its seeds. "Completed" is what the job said; "true" is what the simulator says: the goal, or
every object, lies in the bin.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from math import sqrt
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table

from policy import make_policy
from robotcell.config import load_config
from robotcell.errors import CellError
from robotcell.jobs import run_job
from robotcell.journal import Journal
from robotcell.palette import PALETTE
from sim_twin.backend import open_twin

REQUESTS: tuple[tuple[str, tuple[str, ...] | None, dict[str, Any]], ...] = (
    ("--goal red, 10 objects", ("red",), {"objects": 10}),
    ("--all, 10 objects", None, {"objects": 10}),
    ("--goal red, 30 objects", ("red",), {"objects": 30}),
    ("--all, novel, 10 objects", None, {"scene": "novel", "objects": 10}),
)


@dataclass(frozen=True)
class Trial:
    """One job; counts as in `robotcell.journal.Metrics`."""

    completed: bool
    true: bool
    actions: int
    attempts: int
    successes: int
    wall_s: float


def main() -> None:
    """Run every request on every seed and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="seeds 0 to N - 1")
    parser.add_argument("--policy", default="heuristic")
    arguments = parser.parse_args()
    table = Table("request", "completed", "true", "grasp success", "motions", "wall per job")
    console = Console()
    for name, goals, options in REQUESTS:
        trials = [
            _run(goals, options | {"seed": seed}, arguments.policy)
            for seed in track(range(arguments.seeds), name, console=console)
        ]
        table.add_row(name, *_figures(trials))
    challenging = [
        _run(("red",), {"scene": f"challenging-{number:02d}", "seed": seed}, arguments.policy)
        for number in track(range(1, 11), "challenging, 10 scenes", console=console)
        for seed in range(2)
    ]
    table.add_row("--goal red, challenging scenes", *_figures(challenging))
    console.print(table)


def _run(goals: tuple[str, ...] | None, options: dict[str, Any], policy: str) -> Trial:
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as runs:
        overrides = {f"backend.options.{key}": value for key, value in options.items()}
        config = load_config(None, {**overrides, "journal.runs": runs, "policy.name": policy})
        cell, world = open_twin(config)
        with Journal(config.journal.database_url()) as journal, cell:
            try:
                completed = run_job(cell, make_policy(policy, config), journal, goals).completed
            except CellError:
                completed = False
            metrics = journal.metrics(journal.jobs(limit=1)[0].id)
            colors = {PALETTE[goal] for goal in goals} if goals else None
            wanted = [i for i, (item, _) in enumerate(world.objects()) if colors is None or item.color in colors]
            in_bin = [world.in_bin(i) for i in wanted]
            true = all(in_bin) if goals is None else any(in_bin)
    wall_s = time.perf_counter() - started
    return Trial(completed, true, metrics.actions, metrics.grasp_attempts, metrics.grasp_successes, wall_s)


def _figures(trials: list[Trial]) -> tuple[str, ...]:
    n = len(trials)
    completed = [trial for trial in trials if trial.completed]
    attempts, successes = sum(t.attempts for t in trials), sum(t.successes for t in trials)
    motions = f"{sum(t.actions for t in completed) / len(completed):.1f}" if completed else "-"
    wall = sorted(trial.wall_s for trial in trials)[n // 2]
    return (
        _share(len(completed), n),
        _share(sum(trial.true for trial in trials), n),
        _share(successes, attempts),
        motions,
        f"{wall:.1f} s",
    )


def _share(k: int, n: int) -> str:
    """k of n with its 95 % Wilson interval."""
    if n == 0:
        return "-"
    z, p = 1.96, k / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return f"{k}/{n} = {p:.0%} ({middle - half:.0%} to {middle + half:.0%})"


if __name__ == "__main__":
    main()
