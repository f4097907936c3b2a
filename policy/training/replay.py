"""Prioritised replay: the unit is a state with all that was tried in it, because that shares one forward pass."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from policy.training.config import held_out
from policy.training.shard import PUSH

if TYPE_CHECKING:
    from collections.abc import Iterable

    from policy.training.shard import Shard

# Priority of a state whose errors are all 0, so that it is drawn again one day.
_LEAST_ERROR = 1e-3


@dataclass(frozen=True)
class View:
    """What was seen of one state: `height` (H, W) uint16, `color` (H, W, 3) uint8, `labels` (H, W) uint8."""

    height: npt.NDArray[np.uint16]
    color: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Sample:
    """A state, and what was tried in it.

    Attributes:
        view: the state.
        primitive, row, col, rotation, target: (N,) of the attempts, as in a shard.
        reward: (N,) of one stage.
        following: (N,) index into `views_after`, -1 where an attempt ended its episode.
        views_after: the states after the pushes.
    """

    view: View
    primitive: npt.NDArray[np.int8]
    row: npt.NDArray[np.int16]
    col: npt.NDArray[np.int16]
    rotation: npt.NDArray[np.int8]
    target: npt.NDArray[np.int16]
    reward: npt.NDArray[np.float32]
    following: npt.NDArray[np.int64]
    views_after: tuple[View, ...]


class Replay:
    """The states of the newest shards.

    Scenes that `held_out` keeps for validation are never drawn.

    Args:
        stage: 1 or 2, whose rewards the samples carry.
        capacity_states: states in memory at most (one shard is always kept).
        alpha: exponent of the priorities, 0 = uniform.
    """

    def __init__(self, stage: int, capacity_states: int, alpha: float) -> None:
        self._column = stage - 1
        self._capacity = capacity_states
        self._alpha = alpha
        self._shards: deque[_Indexed] = deque()
        # (error + least)^alpha of every trainable state, in the order of the shards.
        self._priorities: npt.NDArray[np.float64] = np.empty(0)
        self._places: list[tuple[_Indexed, int]] = []

    def __len__(self) -> int:
        """States that can be drawn."""
        return len(self._places)

    def extend(self, shards: Iterable[Shard]) -> None:
        """Add shards, oldest first; their states get the largest priority so far. The oldest give way."""
        top = self._priorities.max(initial=1.0)
        for shard in shards:
            indexed = _Indexed(shard)
            self._shards.append(indexed)
            self._priorities = np.append(self._priorities, np.full(len(indexed.training), top))
        while len(self._shards) > 1 and sum(len(kept.shard.scene) for kept in self._shards) > self._capacity:
            dropped = self._shards.popleft()
            self._priorities = self._priorities[len(dropped.training) :]
        self._places = [(kept, state) for kept in self._shards for state in kept.training]

    def draw(
        self, count: int, beta: float, rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
        """Draw states in proportion to their priorities.

        Returns:
            (count,) indices for `sample` and `update`, and (count,) importance weights (N p)^-beta over the largest.
        """
        cumulated = np.cumsum(self._priorities)
        drawn = np.searchsorted(cumulated, rng.random(count) * cumulated[-1], side="right")
        indices = drawn.clip(0, len(self._places) - 1).astype(np.int64)
        chance = self._priorities[indices] / cumulated[-1]
        weights = (len(self._places) * chance) ** -beta
        return indices, (weights / weights.max()).astype(np.float32)

    def update(self, indices: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        """Take over the mean |TD error| of the attempts of each drawn state."""
        self._priorities[indices] = (errors + _LEAST_ERROR) ** self._alpha

    def sample(self, index: int, next_states: int, rng: np.random.Generator) -> Sample:
        """A drawn state. Of the states after its pushes at most `next_states` are kept, with the pushes into them."""
        indexed, state = self._places[index]
        return indexed.sample(state, self._column, next_states, rng)

    def validation(self, newest: int) -> list[Sample]:
        """The newest held-out states, without the states after their pushes."""
        chosen: list[Sample] = []
        for indexed in reversed(self._shards):
            for state in reversed(indexed.held_out):
                if len(chosen) == newest:
                    return chosen
                chosen.append(indexed.sample(state, self._column))
        return chosen

    @property
    def priorities(self) -> npt.NDArray[np.float64]:
        """(len,) of every state that can be drawn; set to go on from a checkpoint."""
        return np.array(self._priorities)

    @priorities.setter
    def priorities(self, values: npt.NDArray[np.float64]) -> None:
        if values.shape != self._priorities.shape:
            raise ValueError(f"{len(values)} priorities for {len(self._priorities)} states")
        self._priorities = values.astype(np.float64)


class _Indexed:
    """A shard whose attempts can be found by their state."""

    def __init__(self, shard: Shard) -> None:
        self.shard = shard
        self._order = np.argsort(shard.state, kind="stable")
        self._ends = np.searchsorted(shard.state[self._order], np.arange(len(shard.scene) + 1))
        tried = np.flatnonzero(np.diff(self._ends)).tolist()
        self.training = [state for state in tried if not held_out(int(shard.scene[state]))]
        self.held_out = [state for state in tried if held_out(int(shard.scene[state]))]

    def sample(
        self, state: int, column: int, next_states: int | None = None, rng: np.random.Generator | None = None
    ) -> Sample:
        """One state; with `rng` a random choice of the states after it, without none of them."""
        shard = self.shard
        rows = self._order[self._ends[state] : self._ends[state + 1]]
        after = np.where(shard.primitive[rows] == PUSH, shard.next_state[rows], -1)
        views: npt.NDArray[np.int32] = np.empty(0, np.int32)
        following = np.full(len(rows), -1, np.int64)
        if rng is not None:
            views = np.unique(after[after >= 0])
            if len(views) > (next_states or 0):
                views = rng.choice(views, next_states or 0, replace=False)
            matches = after[:, None] == views
            kept = (after < 0) | matches.any(axis=1)
            rows, matches = rows[kept], matches[kept]
            following = np.where(matches.any(axis=1), matches.argmax(axis=1), -1) if len(views) else following[kept]
        return Sample(
            view=self._view(state),
            primitive=shard.primitive[rows],
            row=shard.row[rows],
            col=shard.col[rows],
            rotation=shard.rotation[rows],
            target=shard.target[rows],
            reward=shard.reward[rows, column],
            following=following,
            views_after=tuple(self._view(int(view)) for view in views),
        )

    def _view(self, state: int) -> View:
        shard = self.shard
        return View(shard.height[state], shard.color[state], shard.labels[state])
