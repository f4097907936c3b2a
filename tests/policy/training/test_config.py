from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.training.config import (
    TrainConfig,
    held_out,
    load_train_config,
    save_train_config,
    single_stage,
    with_rounds,
)
from robotcell.errors import ConfigError


def test_what_is_written_reads_back_as_the_same(tmp_path: Path) -> None:
    config = with_rounds(TrainConfig(seed=7, architecture="paper"), stage=2, rounds=3)
    save_train_config(config, tmp_path / "train.toml")
    assert load_train_config(tmp_path / "train.toml") == config


def test_a_file_may_name_a_part_of_a_stage(tmp_path: Path) -> None:
    path = tmp_path / "train.toml"
    path.write_text("[stage1]\nrounds = 5\n")
    config = load_train_config(path)
    assert config.stage1.rounds == 5
    assert config.stage1.updates_per_round == TrainConfig().stage1.updates_per_round


def test_the_example_is_valid() -> None:
    assert load_train_config(Path(__file__).parents[3] / "examples" / "train.toml").stage1.rounds == 3


def test_every_wrong_value_is_named(tmp_path: Path) -> None:
    path = tmp_path / "train.toml"
    path.write_text("sead = 1\n[learning]\ngamma = 1.5\ngrasps = 0\n[stage1]\nrounds = 0\n[stage2]\nstates = nan\n")
    with pytest.raises(ConfigError, match="5 wrong value") as caught:
        load_train_config(path)
    for key in ("sead", "learning.gamma", "learning.grasps", "stage1.rounds", "stage2.states"):
        assert key in str(caught.value)


@pytest.mark.parametrize("content", ["seed = = 1", "\x00", "[stage1]\nrounds = 100000"])
def test_a_wrong_file_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "train.toml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"train\.toml"):
        load_train_config(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_train_config(tmp_path / "train.toml")


def test_no_two_rounds_share_a_scene() -> None:
    seeds = [
        scene
        for config in (TrainConfig(seed=0), TrainConfig(seed=1))
        for stage in (1, 2)
        for round_ in range(config.stage(stage).rounds)
        for scene in config.scene_seeds(stage, round_)
    ]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) == 1_000_000
    assert 0.05 < sum(map(held_out, seeds)) / len(seeds) < 0.10


@given(st.integers(0, 4000), st.integers(1, 2))
def test_scenes_are_whole_numbers_of_32_bits(seed: int, stage: int) -> None:
    config = TrainConfig(seed=seed, first_seed=100_000_000)
    assert config.scene_seeds(stage, config.stage(stage).rounds - 1)[-1] < 2**31


def test_exploration_falls_after_the_warm_up() -> None:
    config = TrainConfig()
    values = [config.exploration(1, round_) for round_ in range(config.stage1.rounds)]
    warm_up = config.stage1.warmup_rounds
    assert values[:warm_up] == [1.0] * warm_up
    assert values[warm_up] == config.stage1.exploration_start
    assert values[-1] == pytest.approx(config.stage1.exploration_end)
    assert values == sorted(values, reverse=True)


def test_a_single_stage_is_as_long_as_both() -> None:
    config = TrainConfig()
    alone = single_stage(config)
    # Whole updates in every round.
    assert 0 <= alone.stage2.updates - (config.stage1.updates + config.stage2.updates) < alone.stage2.rounds
    assert alone.stage2.warmup_rounds == config.stage1.warmup_rounds
    assert single_stage(alone) == alone
