"""`robotcell jobs`: what past jobs did, from the journal."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cli.console import report_error, results
from robotcell.errors import CellError
from robotcell.jobs.journal import Journal, Metrics
from robotcell.jobs.ownership import life

if TYPE_CHECKING:
    from cli.options import CellChoice
    from robotcell.jobs.journal_tables import Job


def list_jobs(cell: CellChoice, limit: int) -> int:
    """Print the newest jobs; returns the exit code."""
    try:
        place = cell.load().journal
        if place.url is None and not place.default_file.exists():
            rows = []
        else:
            with Journal(place.database_url()) as journal:
                rows = [(job, journal.metrics(job.id)) for job in journal.jobs(limit)]
    except CellError as error:
        return report_error(error)
    out = results()
    if not rows:
        out.print("no jobs yet")
        return 0
    table = Table("job", "started (UTC)", "goal", "policy", "status", "picked", "actions", "success", "run")
    for job, metrics in rows:
        table.add_row(
            str(job.id),
            f"{job.started:%Y-%m-%d %H:%M:%S}",
            _goal(job),
            Text(job.policy),
            _status(job),
            str(metrics.grasp_successes),
            str(metrics.actions),
            _percent(metrics.grasp_success_rate),
            Text(job.run_dir, overflow="fold"),
        )
    out.print(table)
    return 0


def show_job(cell: CellChoice, job_id: int) -> int:
    """Print one job with its actions and metrics; returns the exit code."""
    try:
        with Journal(cell.load().journal.database_url()) as journal:
            job, metrics = journal.job(job_id), journal.metrics(job_id)
    except CellError as error:
        return report_error(error)
    out = results()
    heading = f"job {job.id}: pick {_goal(job)} with {job.policy}, {_status(job)}"
    out.print(Text(heading, style="bold"), soft_wrap=True)
    if job.reason:
        out.print(Text(job.reason), soft_wrap=True)
    out.print(_actions(job))
    out.print(_figures(metrics))
    out.print(Text(f"pictures: {job.run_dir}"), soft_wrap=True)
    return 0


def _status(job: Job) -> str:
    """How a job stands; one whose process has ended without a word is interrupted."""
    alive = life(job)
    return job.status if alive is None else alive.value


def _actions(job: Job) -> Table:
    headings = ("", "goal", "action", "x, y, height [m]", "angle [deg]", "q", "seconds", "result", "detail")
    table = Table(*(escape(heading) for heading in headings))
    for index, action in enumerate(job.actions, start=1):
        outcome = action.outcome
        table.add_row(
            str(index),
            action.goal or "any",
            action.primitive,
            f"{action.x:.3f}, {action.y:.3f}, {action.surface_m:.3f}",
            f"{22.5 * action.rotation:.1f}",
            f"{action.q_value:.2f}",
            f"{outcome.ended_s - action.started_s:.1f}" if outcome else "",
            Text(outcome.result if outcome else "cut off"),
            Text(outcome.detail if outcome else "", overflow="fold"),
        )
    return table


def _figures(metrics: Metrics) -> Table:
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in (
        ("motions", str(metrics.actions)),
        ("pushes", str(metrics.pushes)),
        (
            "grasps",
            f"{metrics.grasp_successes} of {metrics.grasp_attempts} ({_percent(metrics.grasp_success_rate)})",
        ),
        ("picked", ", ".join(metrics.picked) or "nothing"),
        (
            "picks per hour",
            "-" if isnan(metrics.picks_per_hour) else f"{metrics.picks_per_hour:.0f}",
        ),
    ):
        table.add_row(Text(name, style="bold"), value)
    return table


def _goal(job: Job) -> str:
    return ",".join(job.goals) if job.goals else "all"


def _percent(share: float) -> str:
    return "-" if isnan(share) else f"{share:.0%}"
