"""`train.toml`: what a training run does, checked as a whole. With no file the defaults train the shipped network."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from robotcell.config import wrong_values
from robotcell.errors import ConfigError
from robotcell.io.input_file import read_toml

if TYPE_CHECKING:
    from pathlib import Path


# Scene seeds that one stage may use before it would meet those of the next stage or of the next `seed`.
_SEEDS_PER_STAGE = 200_000
_MAX_SEED = 4000

# One scene in so many is held out for validation: 6 %.
_HELD_OUT_EVERY = 16

Probability = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


class _Table(BaseModel):
    """A table of train.toml: unknown keys are refused, numbers are finite, nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CollectSettings(_Table):
    """How a scene is played."""

    # Grasps that are tried in every state, each from the same saved state.
    grasps: Annotated[int, Field(ge=0)] = 6
    # Likewise pushes.
    pushes: Annotated[int, Field(ge=0)] = 6
    # States of a scene at most.
    states: Count = 6


class StageSettings(CollectSettings):
    """How long one stage is, how it explores, and how its scenes are played."""

    # Rounds of the stage.
    rounds: Count
    # Scenes that are played in a round.
    scenes_per_round: Count
    # Updates of the network in a round.
    updates_per_round: Count
    # Rounds at the beginning that are played by exploration alone.
    warmup_rounds: Annotated[int, Field(ge=0)]
    # Part of the attempts that explore in the first round after the warm-up.
    exploration_start: Probability
    # The same in the last round; linear in between.
    exploration_end: Probability

    @model_validator(mode="after")
    def _fits_its_seeds(self) -> StageSettings:
        if self.rounds * self.scenes_per_round > _SEEDS_PER_STAGE:
            raise ValueError(f"rounds x scenes_per_round must not exceed {_SEEDS_PER_STAGE}")
        return self

    @property
    def updates(self) -> int:
        """Updates of the whole stage."""
        return self.rounds * self.updates_per_round


class LearningSettings(_Table):
    """Double DQN with prioritised replay."""

    # Grasps in an update.
    grasps: Count = 32
    # Pushes in an update.
    pushes: Count = 32
    # Of Adam at the first update of a stage; follows half a cosine from there to the last.
    learning_rate: Positive = 1e-3
    # At the last update.
    final_learning_rate: Positive = 1e-4
    # Gradients are clipped to it.
    gradient_norm: Positive = 5.0
    # Discount. Paper: "gamma = 0.5".
    gamma: Annotated[float, Field(ge=0, lt=1)] = 0.5
    # Exponent of prioritised replay.
    priority_alpha: Probability = 0.6
    # Exponent of the importance weights at the start of a stage; it grows to 1.
    priority_beta_start: Probability = 0.4
    # Weight of the loss of pushes.
    push_weight: Positive = 1.0
    # States after a push that are valued anew in a round, at least; all that were not valued yet come first.
    values_per_round: Count = 600
    # States in memory; the oldest shards are left out. A state of 224 x 224 cells takes 0.3 MB.
    capacity_states: Count = 16_000


class TrainConfig(_Table):
    """A whole training run."""

    # Another seed gives other scenes, other weights at the start and other draws.
    seed: Annotated[int, Field(ge=0, le=_MAX_SEED)] = 0
    # "fast", or "paper": a large network, 60 times as long for an update, which takes 9 GB.
    architecture: str = "fast"
    # Scenes of training; evaluations use seeds below.
    first_seed: Annotated[int, Field(ge=1_000_000, le=100_000_000)] = 1_000_000
    # Scenes that one worker plays at a time; a shard holds their states.
    scenes_per_task: Count = 2
    # Stage 2 alone, without the weights and the shards of a stage 1 (an ablation).
    single_stage: bool = False
    learning: LearningSettings = LearningSettings()
    stage1: StageSettings = StageSettings(
        rounds=5,
        scenes_per_round=36,
        updates_per_round=350,
        warmup_rounds=1,
        exploration_start=0.5,
        exploration_end=0.1,
    )
    stage2: StageSettings = StageSettings(
        rounds=4,
        scenes_per_round=32,
        updates_per_round=500,
        warmup_rounds=0,
        exploration_start=0.4,
        exploration_end=0.1,
        # What stage I did not learn is which pushes free an object.
        grasps=4,
        pushes=14,
        states=5,
    )

    def stage(self, number: int) -> StageSettings:
        """The settings of stage 1 or 2."""
        return self.stage1 if number == 1 else self.stage2

    def scene_seeds(self, stage: int, round_: int) -> tuple[int, ...]:
        """The scenes of a round: the same for any number of workers, no two rounds share one."""
        scenes = self.stage(stage).scenes_per_round
        first = self.first_seed + (2 * self.seed + stage - 1) * _SEEDS_PER_STAGE + round_ * scenes
        return tuple(range(first, first + scenes))

    def exploration(self, stage: int, round_: int) -> float:
        """The part of the attempts that explore."""
        plan = self.stage(stage)
        if round_ < plan.warmup_rounds:
            return 1.0
        last = plan.rounds - 1 - plan.warmup_rounds
        passed = (round_ - plan.warmup_rounds) / last if last > 0 else 0.0
        return plan.exploration_start + passed * (plan.exploration_end - plan.exploration_start)


def held_out(scene_seed: int) -> bool:
    """Whether a scene is kept for validation and never trained on."""
    return scene_seed % _HELD_OUT_EVERY == 0


def with_rounds(config: TrainConfig, stage: int, rounds: int) -> TrainConfig:
    """The same configuration with another number of rounds in one stage.

    Raises:
        ConfigError: a stage cannot have so many.
    """
    values = config.model_dump()
    values[f"stage{stage}"]["rounds"] = rounds
    return _validated(values, "the number of rounds")


def single_stage(config: TrainConfig) -> TrainConfig:
    """Stage 2 alone with as many scenes and updates as both stages have, and the beginning of stage 1."""
    if config.single_stage:
        return config
    one, two = config.stage1, config.stage2
    rounds = one.rounds + two.rounds
    scenes = one.rounds * one.scenes_per_round + two.rounds * two.scenes_per_round
    alone = two.model_copy(
        update={
            "rounds": rounds,
            "scenes_per_round": -(-scenes // rounds),
            "updates_per_round": -(-(one.updates + two.updates) // rounds),
            "warmup_rounds": one.warmup_rounds,
            "exploration_start": one.exploration_start,
        }
    )
    return _validated(config.model_copy(update={"stage2": alone, "single_stage": True}).model_dump(), "a single stage")


def load_train_config(path: Path | None = None) -> TrainConfig:
    """Read and check a training file; None for the defaults.

    A stage that the file names only in part keeps the defaults of its other values.

    Raises:
        ConfigError: naming every bad key at once, each with its value and what is allowed.
    """
    if path is None:
        return TrainConfig()
    values = read_toml(path, "start from examples/train.toml")
    for name in ("stage1", "stage2"):
        given = values.get(name)
        if isinstance(given, dict):
            values[name] = TrainConfig.model_fields[name].default.model_dump() | given
    return _validated(values, str(path))


def save_train_config(config: TrainConfig, path: Path) -> None:
    """Write the configuration as TOML with all values filled in; it reads back as the same."""
    lines, tables = [], []
    for key, value in config.model_dump().items():
        if isinstance(value, dict):
            # What JSON writes for a number or a string is TOML as well.
            tables += ["", f"[{key}]", *(f"{name} = {json.dumps(inner)}" for name, inner in value.items())]
        else:
            lines.append(f"{key} = {json.dumps(value)}")
    path.write_text("\n".join([*lines, *tables, ""]), encoding="utf-8")


def _validated(values: dict[str, Any], place: str) -> TrainConfig:
    try:
        return TrainConfig.model_validate(values)
    except ValidationError as error:
        problems = wrong_values(error, "docs/reference/training-file.md")
        raise ConfigError("\n  ".join([f"{place}: {len(problems)} wrong value(s)", *problems])) from None
