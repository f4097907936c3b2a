"""A training run: rounds of playing scenes, learning from all that was played, and a checkpoint.

Everything lies in the folder of the run (`policy.training.run_folder`), and everything random is a function of the
configuration and of the number of the round or update. So a run that was killed goes on where it was, and any number
of workers plays the same.
"""

from __future__ import annotations

import fcntl
import math
import time
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch

from policy.network.encoding import GRASP, PUSH
from policy.network.registry import make_network
from policy.rollouts import run_tasks
from policy.training import collect as playing
from policy.training.checkpoint import load_checkpoint, save_checkpoint
from policy.training.config import load_train_config, save_train_config, single_stage, with_rounds
from policy.training.curves import draw_curves
from policy.training.learner import Learner
from policy.training.replay import Replay
from policy.training.run_folder import (
    finished_stage1,
    load_shard,
    newest_shards,
    read_metrics,
    round_of,
    shard_paths,
    write_metrics,
    write_weights,
)
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import make_folder, replaced

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from policy.training.config import TrainConfig
    from policy.training.run_folder import Metrics
    from policy.training.shard import Shard

    # (what is being done, how much of it is done, of how much)
    Progress = Callable[[str, int, int], None]

# Held-out attempts that each round is measured on, the newest.
_VALIDATION_ATTEMPTS = 3000


def train(
    config: TrainConfig,
    stage: int,
    run: Path,
    *,
    workers: int | None = None,
    ray_address: str | None = None,
    collect: Callable[[playing.Collection], Shard] = playing.collect,
    on_progress: Progress = lambda _what, _done, _total: None,
    on_round: Callable[[Metrics], None] = lambda _metrics: None,
) -> Path:
    """Train one stage to its end, from wherever its folder says that it is.

    Args:
        config: of the run, as `prepare` returned it.
        stage: 1 or 2.
        run: folder of the run.
        workers: that play scenes; see `policy.rollouts.run_tasks`.
        ray_address: of a Ray cluster that sees the folder of the run under the same path.
        collect: plays the scenes of a task.
        on_progress: told while a round collects, looks ahead and learns.
        on_round: given the metrics of each round as it ends.

    Returns:
        The trained weights.

    Raises:
        ConfigError: stage 1 is not finished, a file of the run is damaged, or another process trains the stage.
    """
    folder = run / f"stage{stage}"
    with (folder / "lock").open("w") as lock:
        try:
            # Gone with the process, however it ends.
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{folder}: another process trains this stage; wait for it, or end it first") from None
        _train(config, stage, run, folder, workers, ray_address, collect, on_progress, on_round)
    return folder / "weights.safetensors"


def prepare(
    stage: int,
    run: Path,
    config: TrainConfig | None = None,
    *,
    resume: bool = False,
    from_scratch: bool = False,
    rounds: int | None = None,
) -> TrainConfig:
    """Check that a stage can start or go on, and write its train.toml.

    Args:
        stage: 1 or 2.
        run: folder of the run.
        config: None for that of stage 1 when stage 2 starts, or else the defaults. A stage that is resumed has its own.
        resume: whether the stage has been started already.
        from_scratch: stage 2 alone, see `single_stage`.
        rounds: of the stage, instead of what the configuration says.

    Returns:
        The configuration that counts.

    Raises:
        ConfigError: the stage has been started (or has not, with `resume`), or has to wait for stage 1.
        StorageError: its folder or file cannot be written.
    """
    folder = run / f"stage{stage}"
    written = folder / "train.toml"
    if resume:
        if config is not None or from_scratch:
            raise ConfigError("a stage is resumed with the configuration that it was started with; leave out the other")
        if not written.exists():
            raise ConfigError(f"{folder}: there is nothing to resume; start it without --resume")
        config = load_train_config(written)
    else:
        if written.exists():
            raise ConfigError(f"{folder}: this stage was started before; go on with --resume, or choose another --run")
        first = run / "stage1" / "train.toml"
        config = config or load_train_config(first if stage == 2 and first.exists() else None)
        config = single_stage(config) if from_scratch else config
    if rounds is not None:
        config = with_rounds(config, stage, rounds)
    if stage == 1 and config.single_stage:
        raise ConfigError("there is no stage 1 in a single-stage training; use --stage 2")
    if stage == 2 and not config.single_stage:
        finished_stage1(run)
    make_folder(folder / "shards")
    with replaced(written) as part:
        save_train_config(config, part)
    return config


def _train(
    config: TrainConfig,
    stage: int,
    run: Path,
    folder: Path,
    workers: int | None,
    ray_address: str | None,
    collect: Callable[[playing.Collection], Shard],
    on_progress: Progress,
    on_round: Callable[[Metrics], None],
) -> None:
    plan = config.stage(stage)
    torch.manual_seed(config.seed)
    learner = Learner(make_network(config.architecture), config.learning, stage, plan.updates, config.seed)
    earlier = [] if stage == 1 or config.single_stage else _start_from_stage1(run, learner)
    first = 0
    checkpoint = None
    if (folder / "checkpoint.pt").exists():
        checkpoint = load_checkpoint(folder / "checkpoint.pt")
        learner.load_state(checkpoint)
        first = checkpoint["rounds"]
    history = [line for line in read_metrics(run) if (line["stage"], line["round"]) < (stage, first)]
    write_metrics(run, history)
    replay = Replay(stage, config.learning.capacity_states, config.learning.priority_alpha)
    played = [path for path in shard_paths(folder) if round_of(path) < first]
    replay.extend(newest_shards([*earlier, *played], config.learning.capacity_states))
    if checkpoint is None and earlier:
        _take_over_values(replay, load_checkpoint(run / "stage1" / "checkpoint.pt"))
    elif checkpoint is not None and len(checkpoint["priorities"]) == len(replay):
        # Somebody may have deleted a shard; then all attempts are as new.
        replay.priorities = checkpoint["priorities"].numpy()
        replay.value, replay.valued = checkpoint["value"].numpy(), checkpoint["valued"].numpy()
    write_weights(run, folder, config, stage, learner, history)
    for round_ in range(first, plan.rounds):
        start = time.perf_counter()
        shards, collected = _collect(config, stage, round_, folder, collect, workers, ray_address, on_progress)
        replay.extend(shards)
        if replay.attempts.held_out.all():
            raise ConfigError(
                f"{folder / 'shards'}: the scenes of round {round_} gave nothing to learn from; set a larger "
                "scenes_per_round, grasps or pushes, and train into another --run folder"
            )
        learned = _learn(learner, replay, round_, plan.updates_per_round * (round_ + 1), on_progress)
        metrics: Metrics = {
            "stage": stage,
            "round": round_,
            "rounds": plan.rounds,
            "exploration": config.exploration(stage, round_),
            **collected,
            **learned,
            **learner.validate(replay, _VALIDATION_ATTEMPTS),
            "hours": (history[-1]["hours"] if history else 0.0) + (time.perf_counter() - start) / 3600,
        }
        history.append(metrics)
        # The metrics first: a round without a checkpoint is done again, and its line is written anew.
        write_metrics(run, history)
        state = {"rounds": round_ + 1, "stage": stage, "config": config.model_dump_json()}
        state |= {
            "priorities": torch.from_numpy(replay.priorities),
            "value": torch.from_numpy(replay.value),
            "valued": torch.from_numpy(replay.valued),
        }
        save_checkpoint(folder / "checkpoint.pt", {**learner.state(), **state})
        write_weights(run, folder, config, stage, learner, history)
        draw_curves(history, run / "curves.png")
        on_round(metrics)


def _collect(
    config: TrainConfig,
    stage: int,
    round_: int,
    folder: Path,
    collect: Callable[[playing.Collection], Shard],
    workers: int | None,
    ray_address: str | None,
    on_progress: Progress,
) -> tuple[list[Shard], Metrics]:
    """The shards of a round, in the order of its tasks; only those that are not there yet are played."""
    start = time.perf_counter()
    blind = round_ < config.stage(stage).warmup_rounds
    weights = None if blind else (folder / "weights.safetensors").resolve()
    seeds, step = config.scene_seeds(stage, round_), config.scenes_per_task
    missing: dict[Path, playing.Collection] = {}
    paths = []
    for task, first in enumerate(range(0, len(seeds), step)):
        path = folder / "shards" / f"r{round_:04d}-t{task:03d}.npz"
        paths.append(path)
        if not path.exists():
            missing[path] = playing.Collection(
                stage=stage,
                seeds=seeds[first : first + step],
                weights=weights,
                exploration=config.exploration(stage, round_),
                settings=config.stage(stage),
            )
    places = list(missing)
    done, attempts = len(paths) - len(missing), 0
    on_progress("collect", done, len(paths))
    if missing:
        with closing(run_tasks(collect, missing.values(), workers, ray_address)) as results:
            for index, shard in results:
                shard.save(places[index])
                done += 1
                attempts += len(shard.state)
                on_progress("collect", done, len(paths))
    seconds = time.perf_counter() - start
    shards = [load_shard(path) for path in paths]
    return shards, {
        "scenes": len(seeds),
        "states": sum(len(shard.scene) for shard in shards),
        "attempts": sum(len(shard.state) for shard in shards),
        **_success(shards, stage),
        "attempts_per_s": attempts / seconds if missing else math.nan,
        "collect_s": seconds,
    }


def _success(shards: list[Shard], stage: int) -> Metrics:
    """The part of the attempts that was rewarded."""
    primitive = np.concatenate([shard.primitive for shard in shards])
    rewarded = np.concatenate([shard.reward[:, stage - 1] for shard in shards]) > 0
    greedy = np.concatenate([shard.greedy for shard in shards])
    grasps, pushes = primitive == GRASP, primitive == PUSH
    return {
        "grasp_success": _part(rewarded[grasps]),
        "greedy_grasp_success": _part(rewarded[grasps & greedy]),
        "greedy_grasps": int((grasps & greedy).sum()),
        "push_rewarded": _part(rewarded[pushes]),
    }


def _part(values: np.typing.NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _learn(learner: Learner, replay: Replay, round_: int, until: int, on_progress: Progress) -> Metrics:
    """Look ahead, and update until so many updates of the stage are done."""
    start = time.perf_counter()
    learner.look_ahead(replay, round_, partial(on_progress, "look ahead"))
    rate = learner.learning_rate
    first = learner.updates
    losses = []
    while learner.updates < until:
        losses.append(learner.update(replay))
        on_progress("learn", learner.updates - first, until - first)
    grasp, push, error = (
        float(np.nanmean(values)) if not np.isnan(values).all() else math.nan
        for values in (np.array([getattr(loss, name) for loss in losses]) for name in ("grasp", "push", "error"))
    )
    return {
        "replay": len(replay),
        "updates": learner.updates,
        "learning_rate": rate,
        "grasp_loss": grasp,
        "push_loss": push,
        "td_error": error,
        "learn_s": time.perf_counter() - start,
    }


def _start_from_stage1(run: Path, learner: Learner) -> list[Path]:
    """Start from the network of stage 1; its shards."""
    state = finished_stage1(run)
    learner.online.load_state_dict(state["online"])
    learner.target.load_state_dict(state["online"])
    return shard_paths(run / "stage1")


def _take_over_values(replay: Replay, stage1: dict[str, torch.Tensor]) -> None:
    """Begin with the values that stage 1 found, as the oldest: they are of the same objects and nearly the network."""
    if len(stage1["value"]) == len(replay):
        replay.value = stage1["value"].numpy()
        replay.valued = np.minimum(stage1["valued"].numpy(), 0)
