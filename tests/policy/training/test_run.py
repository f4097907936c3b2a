from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from policy.network.weights import load_weights
from policy.training.checkpoint import load_checkpoint, save_checkpoint
from policy.training.config import LearningSettings, StageSettings, TrainConfig
from policy.training.run import prepare, train
from policy.training.run_folder import read_metrics
from policy.training.shard import Shard
from robotcell.errors import ConfigError, StorageError
from tests.policy.training import toy

if TYPE_CHECKING:
    from collections.abc import Callable

STAGE = StageSettings(
    rounds=3,
    scenes_per_round=6,
    updates_per_round=5,
    warmup_rounds=1,
    exploration_start=0.5,
    exploration_end=0.1,
    grasps=6,
    pushes=3,
)
CONFIG = TrainConfig(
    scenes_per_task=2,
    learning=LearningSettings(grasps=2, pushes=2, values_per_round=5, capacity_states=30),
    stage1=STAGE,
    stage2=STAGE.model_copy(update={"rounds": 1, "warmup_rounds": 0}),
)

# A process that trains slowly, and says what it does.
SLOW = """
import sys, time
from pathlib import Path
import torch
from policy.training.config import load_train_config
from policy.training.run import train
from tests.policy.training import toy

torch.set_num_threads(1)
def say(what, done, total):
    print(what, done, total, flush=True)
    time.sleep(0.01 if what == "look ahead" else 0.1)
run = Path(sys.argv[1])
train(load_train_config(run / "stage1" / "train.toml"), 1, run, workers=1, collect=toy.collect, on_progress=say)
"""


def run_stage(run: Path, stage: int = 1, config: TrainConfig | None = CONFIG, **settings: Any) -> TrainConfig:
    ready = prepare(stage, run, config, **settings)
    train(ready, stage, run, workers=1, collect=toy.collect)
    return ready


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose stage 1 went through without interruption; not to be changed."""
    run = tmp_path_factory.mktemp("trained")
    torch.set_num_threads(1)
    run_stage(run)
    return run


@pytest.fixture
def another(trained: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def assert_same(run: Path, other: Path) -> None:
    """The same scenes, attempts, counters and weights."""
    names = sorted(path.name for path in (run / "stage1" / "shards").iterdir())
    assert names == sorted(path.name for path in (other / "stage1" / "shards").iterdir())
    for name in names:
        one, two = (Shard.load(folder / "stage1" / "shards" / name) for folder in (run, other))
        for field in ("scene", "height", "state", "row", "col", "reward", "greedy"):
            np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    timings = {"hours", "collect_s", "learn_s", "attempts_per_s"}
    told = [
        [{key: line[key] for key in line.keys() - timings} for line in read_metrics(folder)] for folder in (run, other)
    ]
    assert str(told[0]) == str(told[1])
    one, two = (load_checkpoint(folder / "stage1" / "checkpoint.pt") for folder in (run, other))
    assert (one["rounds"], one["updates"]) == (two["rounds"], two["updates"]) == (3, 15)
    for name in ("priorities", "value", "valued"):
        assert torch.equal(one[name], two[name])
    for name in ("online", "target"):
        assert all(torch.equal(tensor, two[name][key]) for key, tensor in one[name].items())


def test_a_run_leaves_everything_in_its_folder(trained: Path) -> None:
    assert {path.name for path in trained.iterdir()} == {"stage1", "metrics.jsonl", "curves.png", "weights.safetensors"}
    stage = trained / "stage1"
    assert {path.name for path in stage.iterdir()} == {
        "train.toml",
        "checkpoint.pt",
        "weights.safetensors",
        "shards",
        "lock",
    }
    shards = sorted((stage / "shards").iterdir())
    assert [path.name for path in shards] == [f"r{r:04d}-t{t:03d}.npz" for r in range(3) for t in range(3)]
    seeds = [tuple(dict.fromkeys(Shard.load(path).scene.tolist())) for path in shards]
    assert sum(seeds, ()) == tuple(seed for round_ in range(3) for seed in CONFIG.scene_seeds(1, round_))
    metrics = read_metrics(trained)
    assert [line["round"] for line in metrics] == [0, 1, 2]
    assert [line["updates"] for line in metrics] == [5, 10, 15]
    # Nothing was greedy before there were weights.
    assert [line["greedy_grasps"] for line in metrics] == [0, 72, 72]
    # 12 states of 9 attempts a round; never more than 30 states in memory, in shards of 4.
    assert [line["replay"] for line in metrics] == [108, 216, 252]
    assert (trained / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_the_weights_say_how_they_came_about(trained: Path) -> None:
    network, card = load_weights(trained / "weights.safetensors")
    assert TrainConfig.model_validate_json(card["training"]) == CONFIG
    assert (card["stage"], card["updates"]) == ("1", "15")
    saved = load_checkpoint(trained / "stage1" / "checkpoint.pt")["online"]
    assert all(torch.equal(tensor, saved[name]) for name, tensor in network.state_dict().items())


def test_what_follows_a_push_is_found_in_every_round(trained: Path) -> None:
    state = load_checkpoint(trained / "stage1" / "checkpoint.pt")
    # The oldest shard in memory is one of round 0.
    assert set(state["valued"].tolist()) == {-1, 0, 1, 2}
    assert state["value"][state["valued"] >= 0].any()
    assert not state["value"][state["valued"] < 0].any()
    # The network that values them is that of the round before.
    assert not all(torch.equal(tensor, state["target"][name]) for name, tensor in state["online"].items())


def kill_when(run: Path, said: Callable[[str], bool]) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, str(run)], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3]
    )
    with process:
        assert process.stdout is not None
        for line in process.stdout:
            if said(line):
                process.send_signal(signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL


def test_a_killed_run_goes_on_as_if_nothing_had_happened(trained: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    prepare(1, run, CONFIG)
    kill_when(run, lambda line: line.startswith("collect 2 3"))
    first = {path.name: path.stat().st_mtime_ns for path in (run / "stage1" / "shards").iterdir()}
    assert {"r0000-t000.npz", "r0000-t001.npz"} <= first.keys()
    assert not (run / "stage1" / "checkpoint.pt").exists()
    # The next process finishes round 0, and is killed while it learns in round 1.
    kill_when(
        run, lambda line: line.startswith("learn 3 5") and (run / "stage1" / "shards" / "r0001-t002.npz").exists()
    )
    assert load_checkpoint(run / "stage1" / "checkpoint.pt")["rounds"] == 1
    # As many workers as there are tasks, which may end in any order.
    train(prepare(1, run, resume=True), 1, run, workers=3, collect=toy.collect)
    # Python's own process beside spawned ones; it would live as long as this one.
    resource_tracker._resource_tracker._stop()  # type: ignore[attr-defined]
    assert_same(run, trained)
    for name, written in first.items():
        assert (run / "stage1" / "shards" / name).stat().st_mtime_ns == written


def test_a_round_without_its_checkpoint_is_done_again(another: Path, trained: Path) -> None:
    """As after a kill between the metrics and the checkpoint, or when somebody deletes a damaged one."""
    (another / "stage1" / "checkpoint.pt").unlink()
    with (another / "metrics.jsonl").open("a") as file:
        file.write('{"stage": 1, "rou')
    played: list[object] = []

    def collect(collection: object) -> Shard:
        played.append(collection)
        raise AssertionError

    train(prepare(1, another, resume=True), 1, another, workers=1, collect=collect)
    assert played == []
    assert_same(another, trained)


def test_another_seed_plays_other_scenes(trained: Path, tmp_path: Path) -> None:
    run_stage(tmp_path, config=CONFIG.model_copy(update={"seed": 1}), rounds=1)
    one, two = (set(Shard.load(run / "stage1/shards/r0000-t000.npz").scene) for run in (trained, tmp_path))
    assert not one & two


def test_stage_2_goes_on_from_stage_1(another: Path) -> None:
    before = load_checkpoint(another / "stage1" / "checkpoint.pt")["online"]
    config = prepare(2, another)
    assert config == CONFIG
    told = []
    train(config, 2, another, workers=1, collect=toy.collect, on_round=told.append)
    assert [line["stage"] for line in read_metrics(another)] == [1, 1, 1, 2]
    assert told[0]["updates"] == 5
    assert told[0]["hours"] > read_metrics(another)[2]["hours"]
    after = load_checkpoint(another / "stage2" / "checkpoint.pt")["online"]
    distances = [float((after[name] - tensor).abs().max()) for name, tensor in before.items() if "weight" in name]
    # Five steps of Adam at 0.001 or less: the network is that of stage 1, hardly changed.
    assert 0 < max(distances) < 0.01
    assert (another / "weights.safetensors").read_bytes() == (another / "stage2" / "weights.safetensors").read_bytes()


def test_a_single_stage_needs_no_other(tmp_path: Path) -> None:
    config = run_stage(tmp_path, stage=2, from_scratch=True, rounds=1)
    assert config.single_stage
    assert len(read_metrics(tmp_path)) == 1
    assert np.isnan(read_metrics(tmp_path)[0]["greedy_grasp_success"])


def test_more_rounds_can_be_added(another: Path) -> None:
    run_stage(another, config=None, resume=True, rounds=4)
    assert [line["updates"] for line in read_metrics(another)] == [5, 10, 15, 20]


def test_what_cannot_start_says_why(another: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    with pytest.raises(ConfigError, match="started before; go on with --resume"):
        prepare(1, another, CONFIG)
    with pytest.raises(ConfigError, match="nothing to resume"):
        prepare(1, empty, resume=True)
    with pytest.raises(ConfigError, match="leave out the other"):
        prepare(1, another, CONFIG, resume=True)
    with pytest.raises(ConfigError, match="run --stage 1 first"):
        prepare(2, empty)
    with pytest.raises(ConfigError, match="use --stage 2"):
        prepare(1, empty, from_scratch=True)
    assert not empty.exists()
    path = another / "stage1" / "checkpoint.pt"
    save_checkpoint(path, load_checkpoint(path) | {"rounds": 2})
    with pytest.raises(ConfigError, match="2 of 3 rounds"):
        prepare(2, another)
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot be made"):
        prepare(1, tmp_path / "file")


def test_two_processes_do_not_train_one_stage(another: Path) -> None:
    def collect(_collection: object) -> Shard:
        with pytest.raises(ConfigError, match="another process trains this stage"):
            train(config, 1, another, workers=1, collect=toy.collect)
        raise KeyboardInterrupt

    config = prepare(1, another, resume=True, rounds=4)
    with pytest.raises(KeyboardInterrupt):
        train(config, 1, another, workers=1, collect=collect)
    # The interrupted one has let go.
    train(config, 1, another, workers=1, collect=toy.collect)


def test_a_damaged_shard_is_named(another: Path) -> None:
    (another / "stage1" / "checkpoint.pt").unlink()
    path = another / "stage1" / "shards" / "r0001-t001.npz"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ConfigError, match=r"r0001-t001\.npz: not a whole shard.*delete it"):
        run_stage(another, config=None, resume=True)
    path.unlink()
    run_stage(another, config=None, resume=True)
    assert len(read_metrics(another)) == 3


def test_a_round_that_gives_nothing_is_an_error(tmp_path: Path) -> None:
    # The first scene of all is held out.
    config = CONFIG.model_copy(update={"stage1": STAGE.model_copy(update={"scenes_per_round": 1})})
    with pytest.raises(ConfigError, match="nothing to learn from"):
        run_stage(tmp_path, config=config)


def test_stage_2_begins_with_the_values_that_stage_1_found(tmp_path: Path) -> None:
    learning = CONFIG.learning.model_copy(update={"capacity_states": 1000})
    config = run_stage(tmp_path, config=CONFIG.model_copy(update={"learning": learning}))
    said: list[tuple[str, int, int]] = []
    train(
        prepare(2, tmp_path, config),
        2,
        tmp_path,
        workers=1,
        collect=toy.collect,
        on_progress=lambda *at: said.append(at),
    )
    looked_at = {total for what, _, total in said if what == "look ahead"}
    # Six scenes with one state that pushes lead on from, three pushes in each.
    assert len(looked_at) == 1
    assert max(looked_at) <= 18
