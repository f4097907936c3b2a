"""A benchmark: its settings, its trials one by one, and the folder that holds what came of them.

The folder has `benchmark.json` (settings, versions), `trials.jsonl` (a line per trial as it ended, which is what a
benchmark that was cut off continues from), `pictures/` and the page `index.html`.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from policy import make_policy
from policy.evaluation.metrics import Metrics, measure
from policy.evaluation.suites import find_suite
from policy.evaluation.trials import Failure, Trial, TrialResult, run_trial
from policy.rollouts import run_tasks
from robotcell.config import CellConfig
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import make_folder, replaced, write_whole
from robotcell.io.input_file import MEASUREMENTS_MAX_BYTES, SETTINGS_MAX_BYTES, read_json, read_text
from robotcell.jobs.run_folder import make_run_dir
from robotcell.motion.config_check import check_config

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

# Of benchmark.json, trials.jsonl and the file of `write_json`.
FORMAT_VERSION = 1
_SETTINGS_FILE, _TRIALS_FILE, PICTURES = "benchmark.json", "trials.jsonl", "pictures"
# Another version of these may give other results.
_PACKAGES = ("robotcell", "numpy", "scipy", "opencv-python-headless", "pybullet", "open3d", "torch")


@dataclass(frozen=True)
class Settings:
    """What a benchmark runs.

    Attributes:
        suites, policies: their names.
        trials: how many per scene; None stands for each suite's own number.
        seed: of the first trial of each scene; trial t has seed + t.
        scenes: folder of scene files instead of the suites' own scenes.
        meshes: folder of the OBJ files that they name.
        cell_file: where `cell` came from; None for the twin with its defaults.
        cell: the cell that the trials run in.
        settings: what `--set` said above the cell's file.
    """

    suites: tuple[str, ...]
    policies: tuple[str, ...]
    trials: int | None
    seed: int
    scenes: str | None
    meshes: str | None
    cell_file: str | None
    cell: CellConfig
    settings: tuple[str, ...] = ()

    def command(self) -> str:
        """The command that runs the whole benchmark again."""
        words = ["robotcell", "bench", "--suite", ",".join(self.suites), "--policy", ",".join(self.policies)]
        options = {"--trials": self.trials, "--scenes": self.scenes, "--meshes": self.meshes, "--cell": self.cell_file}
        for option, value in options.items():
            if value is not None:
                words += [option, str(value)]
        for setting in self.settings:
            words += ["--set", setting]
        return shlex.join([*words, "--seed", str(self.seed)])


@dataclass(frozen=True)
class Origin:
    """When a benchmark was started, and by which versions of what."""

    started: str
    versions: dict[str, str]


def plan(settings: Settings) -> list[Trial]:
    """Every trial of a benchmark: all policies side by side on one scene and seed, then the next.

    Raises:
        ConfigError: a suite, policy, number or folder is not one, or the cell is not a twin.
    """
    if settings.trials is not None and settings.trials < 1:
        raise ConfigError(f"{settings.trials} trials per scene were asked for; at least one makes a benchmark")
    if settings.seed < 0:
        raise ConfigError(f"the seed is {settings.seed}; seeds start at 0")
    if settings.cell.backend.name != "twin":
        raise ConfigError(f"backend.name = {settings.cell.backend.name!r}: a benchmark runs in the twin")
    check_config(settings.cell)
    scenes, meshes = (Path(folder) if folder else None for folder in (settings.scenes, settings.meshes))
    suites = {name: find_suite(name, scenes, meshes) for name in settings.suites}
    for name in settings.policies:
        make_policy(name, settings.cell)
    return [
        Trial(name, case, settings.seed + t, policy, settings.cell, settings.cell_file, settings.settings)
        for name, suite in suites.items()
        for case in suite.cases
        for t in range(settings.trials or suite.trials)
        for policy in settings.policies
    ]


def start(settings: Settings) -> Path:
    """A new folder for a benchmark, under `journal.runs` of its cell.

    Raises:
        StorageError: it cannot be made or written to.
    """
    folder = make_run_dir(settings.cell.journal.runs, "bench")
    # A database URL may hold a password, and no trial uses it.
    cell = settings.cell.model_dump(mode="json", exclude={"journal": {"url"}})
    origin = Origin(datetime.now().astimezone().isoformat(timespec="seconds"), _versions())
    head = {"version": FORMAT_VERSION, **asdict(origin), "settings": {**vars(settings), "cell": cell}}
    write_whole(folder / _SETTINGS_FILE, json.dumps(head, indent=1) + "\n")
    make_folder(folder / PICTURES)
    return folder


def load(folder: Path) -> tuple[Settings, Origin]:
    """What a benchmark's folder says of it.

    Raises:
        ConfigError: the folder holds none, or one of another version.
    """
    path = folder / _SETTINGS_FILE
    head = read_json(path, SETTINGS_MAX_BYTES, "--resume names the folder of a benchmark")
    try:
        if head["version"] != FORMAT_VERSION:
            raise ConfigError(f"{path}: version {head['version']}; this program continues version {FORMAT_VERSION}")
        values = head["settings"]
        values["cell"] = CellConfig.model_validate(values["cell"])
        for key in ("suites", "policies", "settings"):
            values[key] = tuple(values.get(key, ()))
        return Settings(**values), Origin(head["started"], head["versions"])
    except (KeyError, TypeError, ValidationError) as error:
        raise ConfigError(f"{path}: not of a benchmark: {error}") from error


def finished(folder: Path, trials: Sequence[Trial]) -> list[TrialResult]:
    """The results that a folder has of these trials, in their order.

    Raises:
        ConfigError: a line is malformed. The last line of a benchmark that was cut off may be half a line, and is
            left out.
    """
    results = {}
    path = folder / _TRIALS_FILE
    if path.exists():
        *lines, _rest = read_text(path, MEASUREMENTS_MAX_BYTES).split("\n")
        for number, line in enumerate(lines, start=1):
            try:
                result = _result(json.loads(line))
            except (KeyError, TypeError, ValueError) as error:
                raise ConfigError(f"{path}, line {number}: not the result of a trial: {error}") from error
            results[result.key] = result
    return [results[trial.key] for trial in trials if trial.key in results]


def run(
    folder: Path, trials: Sequence[Trial], workers: int | None, ray_address: str | None
) -> Generator[TrialResult, None, None]:
    """Run the trials that the folder has no result of; each result is in the folder when it is yielded.

    Raises:
        CellError: as `run_tasks`.
    """
    done = {result.key for result in finished(folder, trials)}
    left = [trial for trial in trials if trial.key not in done]
    with (
        (folder / _TRIALS_FILE).open("a+b") as file,
        closing(run_tasks(run_trial, left, workers, ray_address)) as tasks,
    ):
        _drop_half_line(file)
        for _index, (result, pictures) in tasks:
            for name, jpeg in pictures.items():
                _write_picture(folder / PICTURES / name, jpeg)
            file.write((json.dumps(asdict(result)) + "\n").encode())
            file.flush()
            yield result


def by_suite(results: Sequence[TrialResult]) -> dict[str, dict[str, Metrics]]:
    """The figures of each policy on each suite, in the order of the results."""
    groups: dict[tuple[str, str], list[TrialResult]] = {}
    for result in results:
        groups.setdefault((result.suite, result.policy), []).append(result)
    figures: dict[str, dict[str, Metrics]] = {}
    for (suite, policy), group in groups.items():
        figures.setdefault(suite, {})[policy] = measure(group)
    return figures


def write_json(path: Path, settings: Settings, origin: Origin, results: Sequence[TrialResult]) -> None:
    """Write all metrics and trials.

    Raises:
        StorageError: the file cannot be written.
    """
    figures = {suite: {name: asdict(m) for name, m in row.items()} for suite, row in by_suite(results).items()}
    document = {
        "version": FORMAT_VERSION,
        "command": settings.command(),
        **asdict(origin),
        "metrics": figures,
        "trials": [asdict(result) for result in results],
    }
    write_whole(path, json.dumps(document, indent=1) + "\n")


def _result(values: dict[str, Any]) -> TrialResult:
    return TrialResult(**{**values, "shown": tuple(Failure(**failure) for failure in values["shown"])})


def _write_picture(path: Path, jpeg: bytes) -> None:
    with replaced(path) as part:
        part.write_bytes(jpeg)


def _drop_half_line(file: Any) -> None:
    """Cut off what follows the last line end."""
    file.seek(0)
    file.truncate(file.read().rfind(b"\n") + 1)
    file.seek(0, os.SEEK_END)


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions
