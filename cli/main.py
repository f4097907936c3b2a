"""The `robotcell` command.

Exit codes: 0 complete, 1 not complete, 2 wrong usage or configuration, 3 a device or the safety layer stopped the
cell, 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from types import FrameType

# Everything heavy is imported inside the commands, so that --help answers at once.

app = typer.Typer(
    help="Pick objects with a UR5e, an RG2 and a D415, or with their simulated twin.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
jobs_app = typer.Typer(help="What past jobs did.", invoke_without_command=True, pretty_exceptions_enable=False)
app.add_typer(jobs_app, name="jobs")

CellFile = Annotated[
    Path | None, typer.Option("--cell", help="The cell's TOML file; without one, the twin with its defaults.")
]


@app.command()
def pick(
    goal: Annotated[
        str | None, typer.Option(help="Colour to pick, or several in order: red,blue.", show_default=False)
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Pick everything on the table.")] = False,
    cell: CellFile = None,
    scene: Annotated[
        str | None,
        typer.Option(help="Twin: random, novel, challenging-01 to -10, or a scene file.", show_default=False),
    ] = None,
    meshes: Annotated[
        Path | None,
        typer.Option(help="Twin: folder of the OBJ files that a scene file names.", show_default=False),
    ] = None,
    objects: Annotated[
        int | None, typer.Option(help="Twin: how many objects a random scene has.", show_default=False)
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Twin: the same seed gives the same job.", show_default=False)
    ] = None,
    policy: Annotated[
        str | None, typer.Option(help="Who decides: heuristic, learned, grasp-only, random.", show_default=False)
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Look, decide, plan, check and draw one action; move nothing.")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON summary and nothing else.")] = False,
) -> None:
    """Pick one or several goals, or everything.

    Exit codes: 0 complete, 1 not complete, 2 usage or configuration, 3 device or safety stop.
    """
    from cli.pick import run_pick

    overrides = {
        "backend.options.scene": scene,
        "backend.options.meshes": meshes,
        "backend.options.objects": objects,
        "backend.options.seed": seed,
        "policy.name": policy,
    }
    given = {key: value for key, value in overrides.items() if value is not None}
    raise typer.Exit(run_pick(goal, all_, cell, given, dry_run=dry_run, as_json=json_))


@app.command()
def train(
    stage: Annotated[int, typer.Option(min=1, max=2, help="1: pick anything; 2: pick a goal, after stage 1.")],
    run: Annotated[Path, typer.Option(help="Folder of the run.")] = Path("runs/train"),
    config: Annotated[
        Path | None, typer.Option(help="A training TOML file; without one, the defaults.", show_default=False)
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stage that was stopped.")] = False,
    from_scratch: Annotated[
        bool, typer.Option("--from-scratch", help="Stage 2 without a stage 1, as long as both together.")
    ] = False,
    rounds: Annotated[
        int | None, typer.Option(min=1, help="Rounds of the stage, above the configuration.", show_default=False)
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes that play scenes; one per processor.", show_default=False)
    ] = None,
    ray: Annotated[
        str | None, typer.Option(help="Address of a Ray cluster that plays the scenes.", show_default=False)
    ] = None,
) -> None:
    """Train the policy in the twin.

    Exit codes: 0 trained, 2 usage or configuration, 3 a worker died, 130 interrupted (go on with --resume).
    """
    from cli.train import run_train

    raise typer.Exit(
        run_train(
            stage,
            run,
            config,
            resume=resume,
            from_scratch=from_scratch,
            rounds=rounds,
            workers=workers,
            ray_address=ray,
        )
    )


@app.command()
def bench(
    suite: Annotated[
        str | None,
        typer.Option(
            help="One or several of random, challenging, agnostic, random-all, novel, as a,b.", show_default=False
        ),
    ] = None,
    policy: Annotated[
        str | None, typer.Option(help="Who is compared, as a,b; the cell's own unless given.", show_default=False)
    ] = None,
    trials: Annotated[
        int | None, typer.Option(help="Per scene; as many as make 30 per suite unless given.", show_default=False)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the first trial; 0 unless given.", show_default=False)] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="Folder of scene files to use instead.", show_default=False)
    ] = None,
    meshes: Annotated[
        Path | None, typer.Option(help="Folder of the OBJ files that they name.", show_default=False)
    ] = None,
    cell: CellFile = None,
    json_: Annotated[
        Path | None, typer.Option("--json", help="Write all metrics and trials to this file.", show_default=False)
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="How many trials run at once; 1 unless given.", show_default=False)
    ] = None,
    ray: Annotated[
        str | None, typer.Option(help="Run on the Ray cluster of this address, or 'local'.", show_default=False)
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(help="Continue the benchmark of this folder.", show_default=False)
    ] = None,
) -> None:
    """Compare policies on suites of scenes in the twin, with the paper's metrics and a page of results.

    Exit codes: 0 every trial was run, whatever came of it, 2 usage or configuration, 3 a worker died.
    """
    from cli.bench import run_bench

    options = {
        "suite": suite,
        "policy": policy,
        "trials": trials,
        "seed": seed,
        "scenes": scenes,
        "meshes": meshes,
        "cell": cell,
    }
    given = {key: value for key, value in options.items() if value is not None}
    raise typer.Exit(run_bench(given, resume, json_, workers, ray))


@jobs_app.callback()
def jobs(
    context: typer.Context,
    cell: CellFile = None,
    limit: Annotated[int, typer.Option(min=1, help="How many of the newest jobs.")] = 20,
) -> None:
    """List the newest jobs."""
    if context.invoked_subcommand is None:
        from cli.history import list_jobs

        raise typer.Exit(list_jobs(cell, limit))


@jobs_app.command()
def show(job: Annotated[int, typer.Argument(help="The job's number.")], cell: CellFile = None) -> None:
    """Print one job: its actions, what came of them, and its metrics."""
    from cli.history import show_job

    raise typer.Exit(show_job(cell, job))


def _end(number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(128 + number)


def main() -> None:
    """Entry point of the console script."""
    # As an interrupt does: the arm is stopped and the journal closed before the process ends.
    signal.signal(signal.SIGTERM, _end)
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(130)
