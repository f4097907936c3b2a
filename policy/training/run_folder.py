"""The files of a training run: metrics, shards and weights, and whether stage 1 is finished.

metrics.jsonl, curves.png, weights.safetensors      of the newest round
stage1/, stage2/    train.toml, checkpoint.pt, weights.safetensors, shards/r0003-t002.npz (round, task)
"""

from __future__ import annotations

import json
import math
import shutil
import zipfile
from typing import TYPE_CHECKING

from policy.network.weights import save_weights
from policy.training.checkpoint import load_checkpoint
from policy.training.config import load_train_config
from policy.training.shard import Shard
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import replaced, write_whole

if TYPE_CHECKING:
    from pathlib import Path

    import torch

    from policy.training.config import TrainConfig
    from policy.training.learner import Learner

    Metrics = dict[str, float]


def read_metrics(run: Path) -> list[Metrics]:
    """The metrics of all rounds so far; a line that was cut off by a kill is left out."""
    path = run / "metrics.jsonl"
    if not path.exists():
        return []
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            lines.append({key: math.nan if value is None else value for key, value in json.loads(line).items()})
        except ValueError:
            continue
    return lines


def finished_stage1(run: Path) -> dict[str, dict[str, torch.Tensor]]:
    """The last checkpoint of stage 1.

    Raises:
        ConfigError: its rounds are not all finished.
    """
    folder = run / "stage1"
    path = folder / "checkpoint.pt"
    if not path.exists():
        raise ConfigError(
            f"{folder}: stage 2 goes on from stage 1, and no round of it is finished; run --stage 1 first, or "
            "--from-scratch to do without"
        )
    state = load_checkpoint(path)
    planned = load_train_config(folder / "train.toml").stage1.rounds
    if state["rounds"] < planned:
        raise ConfigError(
            f"{folder}: stage 1 has finished {state['rounds']} of {planned} rounds; run --stage 1 --resume first"
        )
    return state


def shard_paths(folder: Path) -> list[Path]:
    """In the order in which they were asked for."""
    return sorted((folder / "shards").glob("r*-t*.npz"))


def round_of(path: Path) -> int:
    """The round in which a shard was played."""
    return int(path.name[1:5])


def newest_shards(paths: list[Path], capacity_states: int) -> list[Shard]:
    """The newest shards that the replay has room for, oldest first: what fell out of it need not be read."""
    shards: list[Shard] = []
    states = 0
    for path in reversed(paths):
        shard = load_shard(path)
        states += len(shard.scene)
        if shards and states > capacity_states:
            break
        shards.append(shard)
    return shards[::-1]


def load_shard(path: Path) -> Shard:
    """A shard of the run.

    Raises:
        ConfigError: it is damaged.
    """
    try:
        return Shard.load(path)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise ConfigError(
            f"{path}: not a whole shard ({error}); delete it and go on with --resume, which plays its scenes again "
            "if the round needs them"
        ) from error


def write_weights(
    run: Path, folder: Path, config: TrainConfig, stage: int, learner: Learner, history: list[Metrics]
) -> None:
    """Save the online network: for the next round's workers, and as the newest of the run."""
    card = {
        "stage": str(stage),
        "updates": str(learner.updates),
        "training": config.model_dump_json(),
        "last_round": _json(history[-1]) if history else "{}",
    }
    weights = folder / "weights.safetensors"
    save_weights(weights, learner.online, config.architecture, card)
    with replaced(run / weights.name) as part:
        shutil.copyfile(weights, part)


def write_metrics(run: Path, history: list[Metrics]) -> None:
    """Replace the metrics of all rounds.

    Raises:
        StorageError: they cannot be written.
    """
    write_whole(run / "metrics.jsonl", "".join(_json(line) + "\n" for line in history))


def _json(metrics: Metrics) -> str:
    """One line; what is not a number is null."""
    known = {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in metrics.items()}
    return json.dumps(known)
