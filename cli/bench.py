"""`robotcell bench`: runs a benchmark of policies in the twin, prints its table and writes its page."""

from __future__ import annotations

import shlex
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from cli.console import progress, report_error, results
from policy.evaluation.benchmark import Settings, by_suite, finished, load, plan, run, start, write_json
from policy.evaluation.page import write_page
from policy.evaluation.report import results_table
from policy.evaluation.suites import SUITES, describe_suite
from robotcell.config import load_config
from robotcell.errors import CellError, ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from policy.evaluation.metrics import Metrics
    from policy.evaluation.trials import Trial, TrialResult


def run_bench(
    given: Mapping[str, Any],
    resume: Path | None,
    json_file: Path | None,
    workers: int | None,
    ray_address: str | None,
) -> int:
    """Run the command; returns the exit code.

    Args:
        given: the options that say what to run and were given: suite, policy, trials, seed, scenes, meshes, cell.
        resume: folder of a benchmark to continue, which says what to run.
        json_file: where all metrics and trials go.
        workers: see `policy.rollouts.run_tasks`.
        ray_address: likewise.
    """
    try:
        if json_file is not None and not json_file.parent.is_dir():
            raise ConfigError(f"--json {json_file}: there is no folder {json_file.parent}")
        if resume is not None:
            settings = _settings_of(resume, given)
            trials, folder = plan(settings), resume
        else:
            settings = _settings(given)
            trials = plan(settings)
            folder = start(settings)
        settings, origin = load(folder)
        _run(folder, trials, workers, ray_address)
        done = finished(folder, trials)
        page = write_page(folder, settings, origin, done)
        if json_file is not None:
            write_json(json_file, settings, origin, done)
    except CellError as error:
        return report_error(error)
    out = results()
    for suite, figures in by_suite(done).items():
        out.print(_table(suite, settings, figures))
    out.print(Text(f"page: {page}"), soft_wrap=True)
    return 0


def _settings(given: Mapping[str, Any]) -> Settings:
    if "suite" not in given:
        raise ConfigError(f"say --suite, one or several of {', '.join(SUITES)}, or --resume with a benchmark's folder")
    cell_file = given.get("cell")
    cell = load_config(cell_file)
    return Settings(
        suites=_names(given["suite"]),
        policies=_names(given.get("policy", cell.policy.name)),
        trials=given.get("trials"),
        seed=given.get("seed", 0),
        scenes=_path(given.get("scenes")),
        meshes=_path(given.get("meshes")),
        cell_file=_path(cell_file),
        cell=cell,
    )


def _settings_of(folder: Path, given: Mapping[str, Any]) -> Settings:
    """The settings of a benchmark that is continued.

    Raises:
        ConfigError: an option asks for something else than it runs.
    """
    settings, _ = load(folder)
    recorded = {
        "suite": ",".join(settings.suites),
        "policy": ",".join(settings.policies),
        "trials": settings.trials,
        "seed": settings.seed,
        "scenes": settings.scenes,
        "meshes": settings.meshes,
        "cell": settings.cell_file,
    }
    asked = {key: _path(value) if isinstance(value, Path) else value for key, value in given.items()}
    differing = [key for key, value in asked.items() if value != recorded[key]]
    if differing:
        was = ", ".join(f"--{key} {'not given' if recorded[key] is None else recorded[key]}" for key in differing)
        raise ConfigError(f"{folder} has another benchmark ({was}): leave these options out, or start a new one")
    return settings


def _names(words: str) -> tuple[str, ...]:
    """The names of a comma list, each once."""
    return tuple(dict.fromkeys(word.strip() for word in words.split(",")))


def _path(path: Path | None) -> str | None:
    """A path that holds from any folder and for any worker."""
    return None if path is None else str(path.resolve())


def _run(folder: Path, trials: Sequence[Trial], workers: int | None, ray_address: str | None) -> None:
    """Run what is left of the trials under a progress bar."""
    console = progress()
    bar = Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
        console=console,
    )
    try:
        done = finished(folder, trials)
        left = f"{len(trials) - len(done)} of {len(trials)} trials to run"
        console.print(Text(f"{folder}: {left}"), soft_wrap=True)
        with bar, closing(run(folder, trials, workers, ray_address)) as ended:
            task = bar.add_task(_standing(done), total=len(trials), completed=len(done))
            for result in ended:
                done.append(result)
                bar.update(task, advance=1, description=_standing(done))
    except BaseException:
        go_on = shlex.join(["robotcell", "bench", "--resume", str(folder)])
        console.print(Text(f"cut off; to go on from here: {go_on}"), soft_wrap=True)
        raise


def _standing(done: Sequence[TrialResult]) -> str:
    """The completion so far."""
    runs = {policy: [r.completed for r in done if r.policy == policy] for policy in sorted({r.policy for r in done})}
    return "complete: " + (", ".join(f"{name} {sum(each)}/{len(each)}" for name, each in runs.items()) or "-")


def _table(suite: str, settings: Settings, figures: Mapping[str, Metrics]) -> Table:
    content = results_table(suite, SUITES[suite].goal_oriented, figures)
    title = Text(f"{suite}: {describe_suite(suite, settings.scenes)}")
    table = Table(*content.header, title=title, title_justify="left")
    for row in content.rows:
        cells = [f"{cell.text} ({cell.note})" if cell.note else cell.text for cell in row.cells]
        table.add_row(Text(row.label), *cells, style="dim" if row.published else None)
    return table
