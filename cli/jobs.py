"""`robotcell jobs`: the options of the commands that tell what past jobs did."""

from __future__ import annotations

from typing import Annotated

import typer

from cli.options import CellChoice, CellFile, Settings, Verbose

app = typer.Typer(help="What past jobs did.", invoke_without_command=True, pretty_exceptions_enable=False)


@app.callback()
def jobs(
    context: typer.Context,
    cell: CellFile = None,
    settings: Settings = None,
    limit: Annotated[int, typer.Option(min=1, help="How many of the newest jobs.")] = 20,
    verbose: Verbose = False,
) -> None:
    """List the newest jobs."""
    if context.invoked_subcommand is None:
        from cli.history import list_jobs

        raise typer.Exit(list_jobs(CellChoice(cell, settings), limit))


@app.command()
def show(
    job: Annotated[int, typer.Argument(help="The job's number.")],
    cell: CellFile = None,
    settings: Settings = None,
    verbose: Verbose = False,
) -> None:
    """Print one job: its actions, what came of them, and its metrics."""
    from cli.history import show_job

    raise typer.Exit(show_job(CellChoice(cell, settings), job))
