"""A rollout worker: plays scenes, tries several actions in every state, and keeps what came of them.

In each state the saved world is put back after every attempt, so one rendered picture yields a dozen labels: what the
network would do (for any object, and for one object as goal), near misses of it, and what it would not do. After a
push the network's grasp of what was pushed is tried as well: whether that came free is what the push is worth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from policy.antipodal import antipodal_grasps
from policy.finger_clearance import OpenGripper, pad_maps
from policy.learned.selection import best_cells, smoothed
from policy.network.encoding import RESOLUTION_M, encode
from policy.push.candidates import pushable_cells
from policy.push.line import push_line
from policy.shadows import complete_heights
from policy.training.environment import GRASP, PUSH, Outcome, PushGraspEnv, State, Trial
from policy.training.shard import Shard, pack_height
from robotcell.config import load_config

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from policy.network.inference import Inference
    from policy.training.config import CollectSettings
    from robotcell.config import CellConfig

# Of the attempts that exploit, a share takes the best action; the others one of so many of the best.
_GREEDY_SHARE = 0.4
_AMONG_BEST = 300
# A cell for a push is drawn at most so often.
_PUSH_TRIES = 25
# After so many pushes of a state, the grasp that they allow is tried.
_FOLLOWED = 6
# Where no network decides yet: this share of the grasps is drawn from those that look possible.
_GEOMETRIC_SHARE = 0.5
# A state whose best grasp succeeds is left by it, or by a push with this probability (stage I, stage II).
_LEAVE_BY_PUSH = (0.15, 0.35)


class SceneKind(NamedTuple):
    """A kind of scene (`policy.training.scenes`), how many objects it has, and its share of the scenes."""

    kind: str
    least: int
    most: int
    share: float


# Stage I: about ten objects, dropped, as the paper has it; stage II: up to thirty. Or a group, or an object that others
# stand around.
_KINDS = {
    1: (SceneKind("drop", 6, 14, 0.6), SceneKind("packed", 4, 10, 0.2), SceneKind("enclosed", 3, 8, 0.2)),
    2: (SceneKind("drop", 14, 30, 0.35), SceneKind("packed", 4, 12, 0.25), SceneKind("enclosed", 3, 8, 0.4)),
}


@dataclass(frozen=True)
class Collection:
    """What a worker is asked for.

    Attributes:
        stage: 1 or 2.
        seeds: of the scenes to play.
        weights: of the network; None explores without one.
        exploration: share of the attempts that explore.
        settings: how many attempts in a state, and how many states of a scene.
        kinds: of the scenes; those of the stage where none is given.
    """

    stage: int
    seeds: tuple[int, ...]
    weights: Path | None
    exploration: float
    settings: CollectSettings
    kinds: tuple[SceneKind, ...] = ()


@dataclass(frozen=True)
class _Maps:
    """Q maps of a state; None where no network decides."""

    grasp: npt.NDArray[np.float32]
    push: npt.NDArray[np.float32]


@dataclass(frozen=True)
class _Choice:
    primitive: int
    rotation: int
    cell: tuple[int, int]
    greedy: bool = False


@dataclass
class _Book:
    """A shard in the making."""

    states: list[State] = field(default_factory=list)
    scenes: list[int] = field(default_factory=list)
    rows: list[tuple[int, int, int, int, int, int, float, float, int, bool, int]] = field(default_factory=list)

    def add_state(self, state: State, scene: int) -> int:
        self.states.append(state)
        self.scenes.append(scene)
        return len(self.states) - 1

    def add_trial(self, state: int, choice: _Choice, trial: Trial) -> int:
        """Returns the state that the trial led to, -1 where nothing follows."""
        after = -1
        if trial.after is not None and any(goes_on for *_, goes_on in trial.rows):
            after = self.add_state(trial.after, self.scenes[state])
        for (row, col), target, (agnostic, goal), goes_on in trial.rows:
            self.rows.append(
                (
                    *(state, choice.primitive, row, col, choice.rotation, target, agnostic, goal),
                    *(after if goes_on else -1, choice.greedy, int(trial.outcome)),
                )
            )
        return after

    def shard(self) -> Shard:
        column = list(zip(*self.rows, strict=True)) or [()] * 11
        return Shard(
            height=np.stack([pack_height(s.height_m) for s in self.states]),
            color=np.stack([s.heightmap.color for s in self.states]),
            labels=np.stack([s.labels for s in self.states]),
            scene=np.array(self.scenes, np.int32),
            state=np.array(column[0], np.int32),
            primitive=np.array(column[1], np.int8),
            row=np.array(column[2], np.int16),
            col=np.array(column[3], np.int16),
            rotation=np.array(column[4], np.int8),
            target=np.array(column[5], np.int16),
            reward=np.array([column[6], column[7]], np.float32).T.reshape(-1, 2),
            next_state=np.array(column[8], np.int32),
            greedy=np.array(column[9], np.bool_),
            outcome=np.array(column[10], np.int8),
        )


def collect(collection: Collection) -> Shard:
    """Play the scenes; the same collection gives the same shard.

    Raises:
        ConfigError: the weights cannot be read, or a scene cannot be made.
    """
    config = load_config(None, {})
    network = None
    if collection.weights is not None:
        from policy.network.inference import Inference

        network = Inference.load(collection.weights)
    book = _Book()
    env = PushGraspEnv(config, collection.stage)
    try:
        for seed in collection.seeds:
            rng = np.random.default_rng([seed, 1])
            kinds = collection.kinds or _KINDS[collection.stage]
            kind, low, high, _ = kinds[int(rng.choice(len(kinds), p=[kind.share for kind in kinds]))]
            env.reset(seed=seed, options={"kind": kind, "count": int(rng.integers(low, high + 1))})
            _play(env, seed, collection, network, config, rng, book)
    finally:
        env.close()
    return book.shard()


def _play(
    env: PushGraspEnv,
    seed: int,
    collection: Collection,
    network: Inference | None,
    config: CellConfig,
    rng: np.random.Generator,
    book: _Book,
) -> None:
    settings = collection.settings
    known: int | None = None
    for _ in range(settings.states):
        state = env.state
        if not state.occupied:
            return
        # A state that a push led to is in the book already.
        here = known if known is not None else book.add_state(state, seed)
        known = None
        maps = None
        if network is not None:
            objects = state.labels > 0
            maps = _Maps(*(_q(network, state, objects, primitive) for primitive in (GRASP, PUSH)))
        picks: list[_Choice] = []
        useful: list[_Choice] = []
        followed = 0
        for choice in _choices(state, maps, collection, config, rng):
            follow = network is not None and choice.primitive == PUSH and followed < _FOLLOWED
            trial = _try(env, choice, here, network if follow else None, rng, book)
            followed += follow and trial.outcome is Outcome.PUSHED
            if trial.held:
                picks.append(choice)
            elif trial.outcome is Outcome.PUSHED:
                useful.append(choice)
        leave_by_push = useful and (not picks or rng.random() < _LEAVE_BY_PUSH[collection.stage - 1])
        candidates = useful if leave_by_push else picks
        if not candidates:
            return
        choice = candidates[int(rng.integers(len(candidates)))]
        trial = env.advance(choice.primitive, choice.rotation, choice.cell)
        book.add_trial(here, choice, trial)
        if book.states[-1] is trial.after:
            known = len(book.states) - 1


def _try(
    env: PushGraspEnv, choice: _Choice, here: int, network: Inference | None, rng: np.random.Generator, book: _Book
) -> Trial:
    """Note what a choice would come to; with a network, also what the best grasp of the pushed object then would."""
    if network is None:
        trial = env.attempt(choice.primitive, choice.rotation, choice.cell)
        book.add_trial(here, choice, trial)
        return trial
    target = env.state.labels[choice.cell]
    with env.aside():
        trial = env.advance(choice.primitive, choice.rotation, choice.cell)
        after = book.add_trial(here, choice, trial)
        mask = env.state.labels == target
        if after >= 0 and mask.any():
            grasp = _best_grasp(_q(network, env.state, mask, GRASP), mask, 1, rng)
            book.add_trial(after, grasp, env.attempt(grasp.primitive, grasp.rotation, grasp.cell))
    return trial


def _q(network: Inference, state: State, cells: npt.NDArray[np.bool_], primitive: int) -> npt.NDArray[np.float32]:
    return network.maps(encode(state.height_m, state.heightmap.color), cells, primitive)


def _choices(
    state: State, maps: _Maps | None, collection: Collection, config: CellConfig, rng: np.random.Generator
) -> Iterator[_Choice]:
    """What is tried in a state."""
    settings = collection.settings
    objects = state.labels > 0
    geometric = _geometric(state, config, rng) if maps is None else None
    present = list(state.occupied)
    for i in range(settings.grasps):
        explore = maps is None or rng.random() < collection.exploration
        if maps is not None and not explore:
            # The first for any object, as in pick-all; the others with one object as the goal.
            mask = objects if i == 0 else state.labels == present[int(rng.integers(len(present)))]
            yield _best_grasp(maps.grasp, mask, 1 if rng.random() < _GREEDY_SHARE else _AMONG_BEST, rng)
        elif geometric and rng.random() < _GEOMETRIC_SHARE:
            yield geometric[int(rng.integers(len(geometric)))]
        else:
            yield _Choice(GRASP, int(rng.integers(8)), _random_cell(objects, rng))
    weights = np.array([0.1 + state.occupied[label] for label in present])
    for _ in range(settings.pushes):
        # Objects that others stand around are what pushes are for.
        target = state.labels == present[int(rng.choice(len(present), p=weights / weights.sum()))]
        mask = pushable_cells(target, objects, RESOLUTION_M)
        explore = maps is None or rng.random() < collection.exploration
        if maps is not None and not explore:
            yield from _best_push(state, maps.push, mask, config, rng)
        else:
            yield from _random_push(state, mask, config, rng)


def _best_grasp(
    q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], among: int, rng: np.random.Generator
) -> _Choice:
    """One of so many of the best."""
    best = best_cells(smoothed(q, mask, RESOLUTION_M), mask, among)
    i = int(rng.integers(len(best.q)))
    return _Choice(GRASP, int(best.rotation[i]), (int(best.row[i]), int(best.col[i])), greedy=among == 1)


def _best_push(
    state: State, q: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], config: CellConfig, rng: np.random.Generator
) -> Iterator[_Choice]:
    """One of the best pushes, after the best cell if that has no place to begin: the network is to learn that too."""
    greedy = rng.random() < _GREEDY_SHARE
    best = best_cells(q, mask, _AMONG_BEST)
    count = len(best.q)
    for n, i in enumerate(range(count) if greedy else rng.permutation(count)):
        k, row, col = int(best.rotation[i]), int(best.row[i]), int(best.col[i])
        possible = _has_start(state, (row, col), k, config)
        if possible or n == 0:
            yield _Choice(PUSH, k, (row, col), greedy)
        if possible:
            return


def _random_push(
    state: State, mask: npt.NDArray[np.bool_], config: CellConfig, rng: np.random.Generator
) -> Iterator[_Choice]:
    """A push, after one that has no place to begin if such a one is drawn first."""
    for n in range(_PUSH_TRIES):
        cell, k = _random_cell(mask, rng), int(rng.integers(16))
        possible = _has_start(state, cell, k, config)
        if possible or n == 0:
            yield _Choice(PUSH, k, cell)
        if possible:
            return


def _has_start(state: State, cell: tuple[int, int], rotation: int, config: CellConfig) -> bool:
    return push_line(state.height_m, state.free, cell, rotation, config.motion.push_m, RESOLUTION_M) is not None


def _random_cell(mask: npt.NDArray[np.bool_], rng: np.random.Generator) -> tuple[int, int]:
    cells = np.flatnonzero(mask)
    row, col = np.unravel_index(cells[int(rng.integers(len(cells)))], mask.shape)
    return int(row), int(col)


def _geometric(state: State, config: CellConfig, rng: np.random.Generator) -> list[_Choice]:
    """Grasps that look possible, the better ones more often."""
    heights = complete_heights(state.heightmap, config.camera.pose()[:3, 3], config.table.height_m)
    gripper = OpenGripper.of(config)
    maps = pad_maps(heights, state.labels.astype(np.int32), RESOLUTION_M, gripper)
    found = antipodal_grasps(maps, state.labels > 0, gripper)
    likely = np.flatnonzero(found.score > 0)
    if not len(likely):
        return []
    weights = found.score[likely].astype(np.float64)
    drawn = rng.choice(likely, size=50, p=weights / weights.sum())
    return [_Choice(GRASP, int(found.rotation[i]), (int(found.row[i]), int(found.col[i]))) for i in drawn]
