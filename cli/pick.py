"""`robotcell pick`: opens the cell, follows the job and prints what came of it."""

from __future__ import annotations

import json
import sys
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from cli.console import NOT_COMPLETE, progress, report_error, results
from policy import make_policy
from robotcell.album import Album, describe, draw_decision, save_picture
from robotcell.cell import open_cell
from robotcell.config import CellConfig, load_config
from robotcell.errors import CellError, ConfigError
from robotcell.jobs import Decision, Outcome, Report, View, preview, run_job
from robotcell.journal import Journal
from robotcell.perception import check_goal_word

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.status import Status


def run_pick(
    goal: str | None,
    everything: bool,
    cell_file: Path | None,
    overrides: dict[str, Any],
    *,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Run the command; returns the exit code. Progress and errors go to stderr, results to stdout."""
    err = progress()
    started = time.perf_counter()
    try:
        goals = _goals(goal, everything)
        config = load_config(cell_file, overrides)
        if dry_run:
            return _dry_run(goals, config, err, as_json=as_json)
        report = _run(goals, config, err)
    except CellError as error:
        if as_json:
            _print_json({"completed": False, "error": str(error), "wall_s": round(time.perf_counter() - started, 3)})
        return report_error(error)
    summary = _summary(report, time.perf_counter() - started)
    if as_json:
        _print_json(summary)
    else:
        _print_summary(summary, results())
    return 0 if report.completed else NOT_COMPLETE


def _goals(goal: str | None, everything: bool) -> tuple[str, ...] | None:
    """The goals in order; None stands for everything."""
    if everything == (goal is not None):
        raise ConfigError("say either --goal COLOUR (several as red,blue) or --all")
    if goal is None:
        return None
    return tuple(check_goal_word(word.strip()) for word in goal.split(","))


def _run(goals: tuple[str, ...] | None, config: CellConfig, err: Console) -> Report:
    with ExitStack() as stack:
        policy = make_policy(config.policy.name, config)
        journal = stack.enter_context(Journal(config.journal.database_url()))
        status = stack.enter_context(err.status(f"opening the cell ({config.backend.name})"))
        cell = stack.enter_context(open_cell(config))
        album = Album(config)
        report = run_job(cell, policy, journal, goals, (album, _Progress(err, status)))
        status.update("drawing the summary")
        album.finish("complete" if report.completed else f"not complete: {report.reason}")
        return report


def _dry_run(goals: tuple[str, ...] | None, config: CellConfig, err: Console, *, as_json: bool) -> int:
    goal = goals[0] if goals else None
    policy = make_policy(config.policy.name, config)
    with err.status("looking, deciding and planning"), open_cell(config) as cell:
        decision, plan = preview(cell, policy, goal)
    path = config.journal.runs / "dry-run.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    save_picture(draw_decision(decision, config, f"{describe(decision)}: dry run, nothing moved"), path)
    steps = [step.label for step in plan.steps]
    if as_json:
        action = decision.action
        _print_json(
            {
                "dry_run": True,
                "primitive": action.primitive.value,
                "xyz": [round(value, 4) for value in action.xyz],
                "theta_rad": round(action.theta, 4),
                "q_value": round(action.q_value, 4),
                "steps": steps,
                "picture": str(path),
            }
        )
        return 0
    out = results()
    out.print(f"{describe(decision)}; the plan is safe, nothing moved")
    out.print(f"steps: {', '.join(steps)}")
    out.print(f"picture: {path}", soft_wrap=True)
    return 0


class _Progress:
    """Prints a line per action while the job runs."""

    def __init__(self, console: Console, status: Status) -> None:
        self._console = console
        self._status = status

    def started(self, job_id: int, run_dir: Path) -> None:
        """Say where the run is recorded."""
        self._console.print(f"job {job_id}, {run_dir}", soft_wrap=True)
        self._status.update("looking")

    def looked(self, view: View) -> None:
        """Show what is on the table."""
        count = len(view.segmentation.instances)
        self._status.update(f"{count} object{'' if count == 1 else 's'} on the table: deciding")

    def decided(self, decision: Decision) -> None:
        """Show the action that runs."""
        self._status.update(describe(decision))

    def ended(self, decision: Decision, outcome: Outcome) -> None:
        """Print what came of it."""
        style = "green" if outcome.success else "yellow"
        self._console.print(
            Text.assemble(describe(decision), ": ", (outcome.result.value, style), f" ({outcome.detail})"),
            soft_wrap=True,
        )


def _summary(report: Report, wall_s: float) -> dict[str, Any]:
    metrics = report.metrics
    return {
        "completed": report.completed,
        "reason": report.reason,
        "picked": metrics.grasp_successes,
        "picked_objects": list(metrics.picked),
        "actions": metrics.actions,
        "pushes": metrics.pushes,
        "grasp_attempts": metrics.grasp_attempts,
        "grasp_successes": metrics.grasp_successes,
        "simulated_s": round(report.cell_s, 3),
        "wall_s": round(wall_s, 3),
        "job": report.job_id,
        "run_dir": str(report.run_dir),
    }


def _print_json(summary: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(summary) + "\n")


def _print_summary(summary: dict[str, Any], out: Console) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in summary.items():
        if value != "":
            shown = ", ".join(value) if isinstance(value, list) else str(value)
            table.add_row(Text(key.replace("_", " "), style="bold"), Text(shown, overflow="fold"))
    out.print(table)
