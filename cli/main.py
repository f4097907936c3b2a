"""The `robotcell` command.

Exit codes: 0 complete, 1 not complete, 2 wrong usage or configuration, 3 a device or the safety layer stopped the
cell, 129 the terminal was closed, 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from cli.calibrate import app as calibrate_app
from cli.jobs import app as jobs_app
from cli.options import CellChoice, CellFile, Meshes, Objects, Scene, Seed, Settings, Verbose
from cli.served_twin import app as twin_app
from cli.signals import end_cleanly_on_signals

# Everything heavy is imported inside the commands, so that --help answers at once.

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(jobs_app, name="jobs")
app.add_typer(twin_app, name="twin")
app.add_typer(calibrate_app, name="calibrate")


def _version(value: bool) -> None:
    if value:
        from importlib.metadata import version

        typer.echo(f"robotcell {version('robotcell')}")
        raise typer.Exit


@app.callback()
def main_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    verbose: Verbose = False,
) -> None:
    """Pick objects with a UR5e, an RG2 and a D415, or with their simulated twin."""


@app.command()
def pick(
    goal: Annotated[
        str | None, typer.Option(help="Colour to pick, or several in order: red,blue.", show_default=False)
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Pick everything on the table.")] = False,
    cell: CellFile = None,
    settings: Settings = None,
    scene: Scene = None,
    meshes: Meshes = None,
    objects: Objects = None,
    seed: Seed = None,
    policy: Annotated[
        str | None,
        typer.Option(help="Who decides: learned, single-stage, grasp-only, heuristic, random.", show_default=False),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(help="Share of its speed at which every motion is run, 0.05 to 1.", show_default=False),
    ] = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Show each action and ask at the terminal before it is run.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Look, decide, plan, check and draw one action; move nothing.")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON summary and nothing else.")] = False,
    verbose: Verbose = False,
) -> None:
    """Pick one or several goals, or everything.

    Exit codes: 0 complete, 1 not complete, 2 usage or configuration, 3 device or safety stop.
    """
    from cli.pick import run_pick

    options = {
        "--scene": scene,
        "--meshes": meshes,
        "--objects": objects,
        "--seed": seed,
        "--policy": policy,
        "--speed": speed,
    }
    choice = CellChoice(cell, settings, options)
    raise typer.Exit(run_pick(goal, all_, choice, confirm=confirm, dry_run=dry_run, as_json=json_))


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
    verbose: Verbose = False,
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
        Path | None, typer.Option(help="Folder of the mesh files that they name.", show_default=False)
    ] = None,
    cell: CellFile = None,
    settings: Settings = None,
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
    verbose: Verbose = False,
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
        "set": tuple(settings) if settings else None,
    }
    given = {key: value for key, value in options.items() if value is not None}
    raise typer.Exit(run_bench(given, resume, json_, workers, ray))


@app.command()
def doctor(
    cell: CellFile = None,
    settings: Settings = None,
    seconds: Annotated[float, typer.Option(min=0.5, max=60, help="How long latencies are measured.")] = 5.0,
    json_: Annotated[bool, typer.Option("--json", help="Print the findings as JSON and nothing else.")] = False,
    verbose: Verbose = False,
) -> None:
    """Look at every device of a hardware cell, say what is wrong and what to do. Moves nothing.

    Exit codes: 0 nothing is wrong, 2 usage or configuration, 3 something is wrong.
    """
    from cli.doctor import run_doctor

    raise typer.Exit(run_doctor(CellChoice(cell, settings), seconds, as_json=json_))


@app.command()
def resume(
    job: Annotated[
        int | None, typer.Argument(help="The job's number; the last one of the cell unless given.", show_default=False)
    ] = None,
    cell: CellFile = None,
    settings: Settings = None,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON summary and nothing else.")] = False,
    verbose: Verbose = False,
) -> None:
    """Go on with a job that was killed, interrupted or stopped, from where the arm stands.

    Exit codes: as of pick.
    """
    from cli.pick import run_resume

    raise typer.Exit(run_resume(job, CellChoice(cell, settings), as_json=json_))


@app.command()
def stop(
    cell: CellFile = None,
    settings: Settings = None,
    verbose: Verbose = False,
) -> None:
    """Stop the command that has the cell open, from another terminal. This is no emergency stop.

    Exit codes: 0 it has ended and the arm stands, or there was none, 2 usage or configuration, 3 it did not end.
    """
    from cli.operator import run_stop

    raise typer.Exit(run_stop(CellChoice(cell, settings)))


@app.command()
def recover(
    cell: CellFile = None,
    settings: Settings = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask; only where no terminal is. The cell was looked at.")
    ] = False,
    verbose: Verbose = False,
) -> None:
    """After a stop: show what happened, ask, leave the stops of the devices, and take the arm home slowly.

    Exit codes: 0 the arm is ready and no stop stands, 2 usage or configuration, 3 it is not, or the answer was no.
    """
    from cli.operator import run_recover

    raise typer.Exit(run_recover(CellChoice(cell, settings), yes=yes))


def main() -> None:
    """Entry point of the console script."""
    end_cleanly_on_signals()
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(130)
