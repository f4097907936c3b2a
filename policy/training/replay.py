"""Prioritised replay of attempts."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from policy.training.config import held_out

if TYPE_CHECKING:
    from collections.abc import Iterable

    from policy.training.shard import Shard

# Priority of an attempt whose error is 0, so that it is drawn again one day.
_LEAST_ERROR = 1e-2


class View(NamedTuple):
    """What was seen of one state: `height` (H, W) uint16, `color` (H, W, 3) uint8, `labels` (H, W) uint8."""

    height: npt.NDArray[np.uint16]
    color: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.uint8]


class Attempts(NamedTuple):
    """Attempts, one per element.

    Attributes:
        shard: (N,) number of the shard since the replay began.
        state: (N,) in the shard.
        next_state: (N,) in the shard, -1 where the episode ended.
        primitive, row, col, rotation, target: as in a shard.
        reward: of the replay's stage.
        held_out: whether the scene is kept for validation.
    """

    shard: npt.NDArray[np.int64]
    state: npt.NDArray[np.int64]
    next_state: npt.NDArray[np.int64]
    primitive: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]
    col: npt.NDArray[np.int64]
    rotation: npt.NDArray[np.int64]
    target: npt.NDArray[np.int64]
    reward: npt.NDArray[np.float32]
    held_out: npt.NDArray[np.bool_]

    def take(self, rows: npt.NDArray[np.int64]) -> Attempts:
        """Some of them."""
        return Attempts._make(column[rows] for column in self)

    def append(self, others: Attempts) -> Attempts:
        """These and then the others."""
        return Attempts._make(np.concatenate([self[i], others[i]]) for i in range(len(self)))


class Replay:
    """The attempts of the newest shards.

    Args:
        stage: 1 or 2, whose rewards count.
        capacity_states: states in memory at most (one shard is always kept).
        alpha: exponent of the priorities, 0 = uniform.
    """

    def __init__(self, stage: int, capacity_states: int, alpha: float) -> None:
        self._column = stage - 1
        self._capacity = capacity_states
        self._alpha = alpha
        self._shards: deque[Shard] = deque()
        self._first = 0
        self.attempts = Attempts._make(np.empty(0, kind) for kind in (*("i8",) * 8, "f4", "?"))
        # (error + least)^alpha of every attempt.
        self._priority: npt.NDArray[np.float64] = np.empty(0)
        # What can be reached after every attempt, 0 where nothing can; and the round in which that was found, -1: not.
        self.value: npt.NDArray[np.float32] = np.empty(0, np.float32)
        self.valued: npt.NDArray[np.int64] = np.empty(0, np.int64)

    def __len__(self) -> int:
        """Attempts in memory, those for validation included."""
        return len(self.value)

    def extend(self, shards: Iterable[Shard]) -> None:
        """Add shards, oldest first; their attempts get the largest priority so far. The oldest give way."""
        for shard in shards:
            number = self._first + len(self._shards)
            self._shards.append(shard)
            new = self._attempts(shard, number)
            top = self._priority.max(initial=1.0)
            self.attempts = self.attempts.append(new)
            self._priority = np.append(self._priority, np.full(len(new.row), top))
            self.value = np.append(self.value, np.zeros(len(new.row), np.float32))
            self.valued = np.append(self.valued, np.full(len(new.row), -1))
        while len(self._shards) > 1 and sum(len(kept.scene) for kept in self._shards) > self._capacity:
            self._shards.popleft()
            self._first += 1
        kept = np.flatnonzero(self.attempts.shard >= self._first)
        if len(kept) < len(self):
            self.attempts = self.attempts.take(kept)
            self._priority, self.value, self.valued = self._priority[kept], self.value[kept], self.valued[kept]

    def draw(
        self, primitive: int, count: int, beta: float, rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
        """Draw attempts of a primitive in proportion to their priorities, never those for validation.

        Returns:
            (count,) numbers of the attempts, and (count,) importance weights (N p)^-beta over the largest; both empty
            where there is none to draw.
        """
        pool = np.flatnonzero((self.attempts.primitive == primitive) & ~self.attempts.held_out)
        if not len(pool):
            return pool, np.empty(0, np.float32)
        cumulated = np.cumsum(self._priority[pool])
        drawn = np.searchsorted(cumulated, rng.random(count) * cumulated[-1], side="right").clip(0, len(pool) - 1)
        weights = (len(pool) * self._priority[pool[drawn]] / cumulated[-1]) ** -beta
        return pool[drawn], (weights / weights.max()).astype(np.float32)

    def update(self, numbers: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        """Take over the |TD error| of drawn attempts."""
        self._priority[numbers] = (errors + _LEAST_ERROR) ** self._alpha

    def view(self, shard: int, state: int) -> View:
        """What was seen of a state."""
        kept = self._shards[shard - self._first]
        return View(kept.height[state], kept.color[state], kept.labels[state])

    def validation(self, newest: int) -> npt.NDArray[np.int64]:
        """Numbers of the newest attempts that are kept for validation."""
        return np.flatnonzero(self.attempts.held_out)[-newest:]

    @property
    def priorities(self) -> npt.NDArray[np.float64]:
        """(len,) of every attempt; set to go on from a checkpoint."""
        return np.array(self._priority)

    @priorities.setter
    def priorities(self, values: npt.NDArray[np.float64]) -> None:
        if values.shape != self._priority.shape:
            raise ValueError(f"{len(values)} priorities for {len(self._priority)} attempts")
        self._priority = values.astype(np.float64)

    def _attempts(self, shard: Shard, number: int) -> Attempts:
        kept_out = np.array([held_out(int(seed)) for seed in shard.scene], np.bool_)
        return Attempts(
            shard=np.full(len(shard.state), number, np.int64),
            state=shard.state.astype(np.int64),
            next_state=shard.next_state.astype(np.int64),
            primitive=shard.primitive.astype(np.int64),
            row=shard.row.astype(np.int64),
            col=shard.col.astype(np.int64),
            rotation=shard.rotation.astype(np.int64),
            target=shard.target.astype(np.int64),
            reward=shard.reward[:, self._column].astype(np.float32),
            held_out=kept_out[shard.state],
        )
