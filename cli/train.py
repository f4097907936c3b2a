"""`robotcell train`: follows a training run and prints a line for each of its rounds."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cli.console import progress, report_error, results
from robotcell.errors import CellError, ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

_INTERRUPTED = 130


def run_train(
    stage: int,
    run: Path,
    config_file: Path | None,
    *,
    resume: bool,
    from_scratch: bool,
    rounds: int | None,
    workers: int | None,
    ray_address: str | None,
) -> int:
    """Run the command; returns the exit code. Progress and errors go to stderr, the path of the weights to stdout."""
    err = progress()
    try:
        weights = _train(stage, run, config_file, resume, from_scratch, rounds, workers, ray_address, err)
    except CellError as error:
        return report_error(error)
    except KeyboardInterrupt:
        err.print(f"interrupted; go on with: robotcell train --stage {stage} --run {run} --resume", soft_wrap=True)
        return _INTERRUPTED
    results().print(str(weights), soft_wrap=True)
    return 0


def _train(
    stage: int,
    run: Path,
    config_file: Path | None,
    resume: bool,
    from_scratch: bool,
    rounds: int | None,
    workers: int | None,
    ray_address: str | None,
    err: Console,
) -> Path:
    # Read when PyTorch is loaded. Where other programs use the processor, threads that wait by spinning take it from
    # those that work, and an update takes several times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        from policy.training.config import load_train_config
        from policy.training.run import prepare, train
    except ImportError as error:
        raise ConfigError(f"training cannot start ({error}): pip install 'robotcell[twin,train]'") from error

    given = load_train_config(config_file) if config_file else None
    config = prepare(stage, run, given, resume=resume, from_scratch=from_scratch, rounds=rounds)
    if workers is None and ray_address is None:
        workers = os.cpu_count() or 1
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as bars:
        bar = bars.add_task("start", total=None)

        def follow(what: str, done: int, total: int) -> None:
            if bars.tasks[0].description != what:
                bars.reset(bar, description=what, total=total)
            bars.update(bar, completed=done, total=total)

        def tell(metrics: dict[str, float]) -> None:
            err.print(_line(metrics), soft_wrap=True)

        return train(config, stage, run, workers=workers, ray_address=ray_address, on_progress=follow, on_round=tell)


def _line(metrics: dict[str, float]) -> str:
    """One round in words."""
    rate = metrics["attempts_per_s"]
    played = "played before" if math.isnan(rate) else f"{rate:.1f}/s"
    return (
        f"round {metrics['round'] + 1:.0f}/{metrics['rounds']:.0f}: "
        f"{metrics['attempts']:.0f} attempts ({played}), "
        f"grasps {_percent(metrics['grasp_success'])} (greedy {_percent(metrics['greedy_grasp_success'])}), "
        f"pushes {_percent(metrics['push_rewarded'])} | "
        f"loss {metrics['grasp_loss']:.3f} + {metrics['push_loss']:.3f}, |TD| {metrics['td_error']:.3f}, "
        f"AUC {metrics['grasp_auc']:.3f}, {metrics['push_auc']:.3f} | "
        f"{metrics['collect_s']:.0f} s + {metrics['learn_s']:.0f} s, {metrics['hours']:.2f} h"
    )


def _percent(part: float) -> str:
    return "-" if math.isnan(part) else f"{100 * part:.0f} %"
