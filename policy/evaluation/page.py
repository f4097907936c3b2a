"""The page of a benchmark: one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from policy.evaluation.benchmark import PICTURES, by_suite
from policy.evaluation.metrics import BOOTSTRAP_RESAMPLES, BOOTSTRAP_SEED
from policy.evaluation.report import Table, failures_table, results_table, scenes_table
from policy.evaluation.suites import SUITES, describe_suite
from robotcell.errors import ConfigError
from robotcell.io.html_page import write_html_page

if TYPE_CHECKING:
    from collections.abc import Sequence

    from policy.evaluation.benchmark import Origin, Settings
    from policy.evaluation.trials import Failure, TrialResult

# Pictures that a policy may show of each suite, which keeps the page below some ten megabytes; all are in the folder.
_SHOWN = 12
_TEMPLATE = Path(__file__).with_name("page.html.j2")


@dataclass(frozen=True)
class _Figure:
    """A picture of the gallery: what failed, in which trial, and the picture as a data URI."""

    failure: Failure
    trial: TrialResult
    source: str


@dataclass(frozen=True)
class _Section:
    """A suite on the page."""

    name: str
    title: str
    results: Table
    failures: Table
    scenes: Table | None
    gallery: tuple[_Figure, ...]
    left_out: int


def write_page(folder: Path, settings: Settings, origin: Origin, results: Sequence[TrialResult]) -> Path:
    """Write `index.html` into a benchmark's folder; its path.

    Raises:
        ConfigError: a picture of the folder is missing.
        StorageError: it cannot be written.
    """
    path = folder / "index.html"
    write_html_page(
        path,
        _TEMPLATE,
        {
            "settings": settings,
            "origin": origin,
            "sections": _sections(folder, settings, results),
            "resamples": BOOTSTRAP_RESAMPLES,
            "bootstrap_seed": BOOTSTRAP_SEED,
        },
    )
    return path


def _sections(folder: Path, settings: Settings, results: Sequence[TrialResult]) -> list[_Section]:
    sections = []
    for name, figures in by_suite(results).items():
        trials = [result for result in results if result.suite == name]
        several = len({trial.scene for trial in trials}) > 1
        gallery, left_out = _gallery(folder, trials)
        sections.append(
            _Section(
                name=name,
                title=describe_suite(name, settings.scenes),
                results=results_table(name, SUITES[name].goal_oriented, figures),
                failures=failures_table(figures),
                scenes=scenes_table(trials) if several else None,
                gallery=gallery,
                left_out=left_out,
            )
        )
    return sections


def _gallery(folder: Path, trials: Sequence[TrialResult]) -> tuple[tuple[_Figure, ...], int]:
    """The failures to show, those of incomplete trials first, and how many are left out."""
    figures: list[_Figure] = []
    left_out = 0
    for policy in dict.fromkeys(trial.policy for trial in trials):
        own = sorted((trial for trial in trials if trial.policy == policy), key=lambda trial: trial.completed)
        shown = [(trial, failure) for trial in own for failure in trial.shown]
        figures += [_Figure(failure, trial, _inlined(folder, failure.picture)) for trial, failure in shown[:_SHOWN]]
        left_out += len(shown[_SHOWN:])
    return tuple(figures), left_out


def _inlined(folder: Path, name: str) -> str:
    path = folder / PICTURES / name
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; a benchmark's folder holds its pictures") from error
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()
