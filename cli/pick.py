"""`robotcell pick`: opens the cell, follows the job and prints what came of it."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack, nullcontext, suppress
from typing import TYPE_CHECKING, Any

import typer
from rich.table import Table
from rich.text import Text

from cli.console import error_as_json, print_json, progress, report_error, results
from cli.findings import print_findings
from cli.keyboard import KeyboardHold
from policy import make_policy
from robotcell.config import find_backend
from robotcell.errors import CellError, ConfigError, NoTarget, StorageError, UnsafeMotion
from robotcell.findings import Grade
from robotcell.io.images import write_image
from robotcell.jobs.job import Report, preview, resume_job, run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.opening import open_cell
from robotcell.jobs.pictures import JobPictures, describe, draw_preview
from robotcell.jobs.run_folder import make_run_dir
from robotcell.motion.config_check import check_config
from robotcell.motion.grasp import Grasp
from robotcell.perception.goals import goal_color

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.status import Status

    from cli.options import CellChoice
    from robotcell.config import CellConfig
    from robotcell.findings import Finding
    from robotcell.jobs.decision import Decision
    from robotcell.jobs.journal_tables import Job
    from robotcell.jobs.verdict import Outcome
    from robotcell.motion.actions import Action
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.view import View


def run_pick(
    goal: str | None,
    everything: bool,
    cell: CellChoice,
    *,
    confirm: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Run the command; returns the exit code. Progress and errors go to stderr, results to stdout."""
    started = time.perf_counter()
    report, error = None, None
    try:
        goals = _goals(goal, everything)
        config = cell.load()
        check_config(config)
        if confirm and (dry_run or not sys.stdin.isatty()):
            why = "a dry run moves nothing" if dry_run else "there is no terminal to ask at"
            raise ConfigError(f"--confirm: {why}: leave it out")
        if dry_run:
            return _dry_run(goals, config, as_json=as_json)
        report, error = _run(goals, None, config, confirm=confirm)
    except CellError as refusal:
        error = refusal
    return _conclude(report, error, started, as_json=as_json)


def run_resume(job_id: int | None, cell: CellChoice, *, as_json: bool) -> int:
    """Go on with a job, the last one of the cell unless `job_id` says which; returns the exit code."""
    started = time.perf_counter()
    report, error = None, None
    try:
        config = cell.load()
        check_config(config)
        if config.journal.url is None and not config.journal.default_file.exists():
            raise ConfigError(f"there is no journal {config.journal.default_file}: start a job with robotcell pick")
        with Journal(config.journal.database_url()) as journal:
            job = _last_job(journal, config) if job_id is None else journal.job(job_id)
        config = config.model_copy(update={"policy": config.policy.model_copy(update={"name": job.policy})})
        report, error = _run(None, job.id, config)
    except CellError as refusal:
        error = refusal
    return _conclude(report, error, started, as_json=as_json)


def _last_job(journal: Journal, config: CellConfig) -> Job:
    name = find_backend(config.backend.name).cell_name(config)
    if name is None:
        raise ConfigError("a twin without servers ends with its process, and so do its jobs: start a new one")
    job = journal.newest_job(name)
    if job is None:
        raise ConfigError("the journal has no job of this cell: start one with robotcell pick")
    return job


def _conclude(report: Report | None, error: CellError | None, started: float, *, as_json: bool) -> int:
    """Print what came of a job; returns the exit code."""
    if error is None and report is not None and not report.completed:
        # What is asked for is not there, or was given up.
        error = NoTarget(report.reason)
    summary = _summary(report, error, time.perf_counter() - started)
    if as_json:
        print_json(summary)
    elif report is not None:
        _print_summary(summary, results())
    return report_error(error) if error else 0


def _goals(goal: str | None, everything: bool) -> tuple[str, ...] | None:
    """The goals in order; None stands for everything."""
    if everything == (goal is not None):
        raise ConfigError("say either --goal COLOUR (several as red,blue) or --all")
    if goal is None:
        return None
    words = tuple(word.strip().lower() for word in goal.split(","))
    for word in words:
        goal_color(word)
    return words


def _run(
    goals: tuple[str, ...] | None, resumed: int | None, config: CellConfig, *, confirm: bool = False
) -> tuple[Report | None, CellError | None]:
    """Run a job to its end, a new one or one that is resumed; the report, and the error that stopped it.

    Whatever started leaves its pictures.
    """
    err = progress()
    with ExitStack() as stack:
        policy = make_policy(config.policy.name, config)
        journal = stack.enter_context(Journal(config.journal.database_url()))
        status = stack.enter_context(err.status(f"opening the cell ({config.backend.name})"))
        cell = stack.enter_context(open_cell(config))
        pictures, following = JobPictures(config), _Progress(config, err, status)
        error = None
        try:
            # Whoever is asked before each action answers at the keyboard, and holds the job by not answering.
            hold = None if confirm else stack.enter_context(KeyboardHold(following.tell))
            if resumed is None:
                ask = following.ask if confirm else None
                report = run_job(cell, policy, journal, goals, (pictures, following), hold, ask)
            else:
                report = resume_job(cell, policy, journal, resumed, (pictures, following), hold)
        except CellError as stop:
            if following.job is None:
                raise
            job_id, run_dir = following.job
            error = stop
            report = Report(
                job_id, run_dir, False, str(stop), journal.metrics(job_id), journal.job(job_id).cell_s or 0.0
            )
        status.update("drawing the summary")
        # What stopped the job says more than pictures that cannot be written.
        with nullcontext() if error is None else suppress(StorageError):
            pictures.finish("complete" if report.completed else f"not complete: {report.reason}")
        return report, error


def _dry_run(goals: tuple[str, ...] | None, config: CellConfig, *, as_json: bool) -> int:
    goal = goals[0] if goals else None
    policy = make_policy(config.policy.name, config)
    with progress().status("looking, deciding and planning"), open_cell(config) as cell:
        decision, plan = preview(cell, policy, goal)
    path = make_run_dir(config.journal.runs, "dry-run") / "plan.png"
    verdict = "refused, see the last panel" if isinstance(plan, UnsafeMotion) else "dry run, nothing moved"
    write_image(path, draw_preview(decision, plan, config, f"{describe(decision)}: {verdict}"))
    if isinstance(plan, UnsafeMotion):
        raise UnsafeMotion(f"{describe(decision)}: {plan}; picture: {path}") from plan
    steps = [step.label for step in plan.plan.steps]
    if as_json:
        action = decision.action
        print_json(
            {
                "dry_run": True,
                **_as_json(action),
                "theta_rad": round(action.theta, 4),
                "q_value": round(action.q_value, 4),
                "steps": steps,
                "picture": str(path),
            }
        )
        return 0
    out = results()
    out.print(Text(f"{describe(decision)}; the plan is safe, nothing moved"), soft_wrap=True)
    out.print(Text(f"steps: {', '.join(steps)}"), soft_wrap=True)
    out.print(Text(f"picture: {path}"), soft_wrap=True)
    return 0


def _as_json(action: Action) -> dict[str, Any]:
    """Where an action begins and ends: x and y in the base frame, heights above the table, all in metres."""
    if isinstance(action, Grasp):
        place = {"x": action.x, "y": action.y, "surface_m": action.surface_m}
        return {"primitive": "grasp", **{key: round(value, 4) for key, value in place.items()}}
    start, end = ([round(v, 4) for v in at] for at in (action.start, action.end))
    return {"primitive": "push", "start": start, "end": end, "top_m": round(action.top_m, 4)}


class _Progress:
    """Prints a line per action while the job runs."""

    def __init__(self, config: CellConfig, console: Console, status: Status) -> None:
        self._config = config
        self._console = console
        self._status = status
        # The job's number and folder, once it has started.
        self.job: tuple[int, Path] | None = None

    def started(self, job_id: int, run_dir: Path) -> None:
        """Say where the run is recorded."""
        self.job = job_id, run_dir
        self._console.print(Text(f"job {job_id}, {run_dir}"), soft_wrap=True)
        self._status.update("looking")

    def tell(self, words: str) -> None:
        """Print what the operator did."""
        self._console.print(words, style="bold")

    def checked(self, findings: Sequence[Finding]) -> None:
        """Print what the preflight found that could be better; what refuses the job is the error that ends it."""
        notes = [finding for finding in findings if finding.grade is Grade.NOTE]
        self._console.print(Text(f"preflight: {len(findings)} findings, {len(notes)} of them notes"))
        if notes:
            print_findings(notes, self._console)

    def looked(self, view: View) -> None:
        """Show what is on the table."""
        count = len(view.segmentation.instances)
        self._status.update(f"{count} object{'' if count == 1 else 's'} on the table: deciding")

    def decided(self, decision: Decision) -> None:
        """Show the action that runs."""
        self._status.update(describe(decision))

    def ask(self, decision: Decision, checked: CheckedPlan) -> bool:
        """Show an action and ask at the terminal whether it shall run; an interrupt ends the job."""
        page = draw_preview(decision, checked, self._config, f"{describe(decision)}: to be confirmed")
        if self.job is not None:
            path = self.job[1] / f"confirm-{decision.index:03d}.png"
            write_image(path, page)
            self._console.print(Text(f"picture: {path}"), soft_wrap=True)
        self._console.print(Text(f"steps: {', '.join(step.label for step in checked.plan.steps)}"), soft_wrap=True)
        self._status.stop()
        try:
            return typer.confirm(f"{describe(decision)}: run it? (n: another one, Ctrl-C: end the job)", err=True)
        except typer.Abort:
            raise KeyboardInterrupt from None
        finally:
            self._status.start()

    def ended(self, decision: Decision, outcome: Outcome) -> None:
        """Print what came of it."""
        style = "green" if outcome.success else "yellow"
        self._console.print(
            Text.assemble(describe(decision), ": ", (outcome.result.value, style), f" ({outcome.detail})"),
            soft_wrap=True,
        )


def _summary(report: Report | None, error: CellError | None, wall_s: float) -> dict[str, Any]:
    """What came of the command; zeros where no job was started."""
    metrics = report.metrics if report else None
    return {
        "completed": report.completed if report else False,
        "reason": str(error) if error else "",
        **error_as_json(error),
        "picked": metrics.grasp_successes if metrics else 0,
        "picked_objects": list(metrics.picked) if metrics else [],
        "actions": metrics.actions if metrics else 0,
        "pushes": metrics.pushes if metrics else 0,
        "grasp_attempts": metrics.grasp_attempts if metrics else 0,
        "grasp_successes": metrics.grasp_successes if metrics else 0,
        "simulated_s": round(report.cell_s, 3) if report else 0.0,
        "wall_s": round(wall_s, 3),
        "job": report.job_id if report else None,
        "run_dir": str(report.run_dir) if report else None,
    }


def _print_summary(summary: dict[str, Any], out: Console) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in summary.items():
        if value is not None and value != "":
            shown = ", ".join(value) if isinstance(value, list) else str(value)
            table.add_row(Text(key.replace("_", " "), style="bold"), Text(shown, overflow="fold"))
    out.print(table)
