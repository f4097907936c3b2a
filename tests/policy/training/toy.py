"""Scenes of flat bars on a small table, where what succeeds can be read off the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from policy.network.encoding import GRASP, PUSH
from policy.training.shard import Shard, pack_height

if TYPE_CHECKING:
    from policy.training.collect import Collection

SIZE = 64
_HEIGHT_M = 0.05
_LENGTH, _WIDTH = 26.0, 8.0


def collect(collection: Collection) -> Shard:
    """Two states of each scene; a push leads from the first to the second.

    A grasp succeeds across its bar. A push is rewarded along its bar.
    """
    rng = np.random.default_rng([collection.stage, *collection.seeds])
    states = [(seed, _bars(rng)) for seed in collection.seeds for _ in range(2)]
    maps = [_draw(bars, rng) for _, bars in states]
    rows = []
    for state, (_, bars) in enumerate(states):
        labels = maps[state][2]
        for primitive, count in ((GRASP, collection.settings.grasps), (PUSH, collection.settings.pushes)):
            cells = np.argwhere(labels > 0)
            for row, col in cells[rng.integers(len(cells), size=count)]:
                target = int(labels[row, col])
                plane = int(rng.integers(8 if primitive == GRASP else 16))
                *_, along = bars[target - 1]
                if primitive == GRASP:
                    reward = float((plane - along) % 8 in (3, 4, 5))
                else:
                    reward = 0.5 * float((plane - along) % 8 in (7, 0, 1))
                after = state + 1 if primitive == PUSH and state % 2 == 0 else -1
                rows.append((state, primitive, row, col, plane, target, reward, after))
    columns = np.array(rows).T
    return Shard(
        height=np.stack([height for height, _, _ in maps]),
        color=np.stack([color for _, color, _ in maps]),
        labels=np.stack([labels for _, _, labels in maps]),
        scene=np.array([seed for seed, _ in states], np.int32),
        state=columns[0].astype(np.int32),
        primitive=columns[1].astype(np.int8),
        row=columns[2].astype(np.int16),
        col=columns[3].astype(np.int16),
        rotation=columns[4].astype(np.int8),
        target=columns[5].astype(np.int16),
        reward=np.stack([columns[6], columns[6]], axis=1).astype(np.float32),
        next_state=columns[7].astype(np.int32),
        greedy=np.full(len(rows), collection.weights is not None),
        outcome=np.zeros(len(rows), np.int8),
    )


def _bars(rng: np.random.Generator) -> list[tuple[float, float, int]]:
    """(x, y, direction in steps of 22.5 degrees) of each bar; they do not touch."""
    return [(float(x), float(rng.integers(20, SIZE - 20)), int(rng.integers(8))) for x in (16, SIZE - 17)]


def _draw(
    bars: list[tuple[float, float, int]], rng: np.random.Generator
) -> tuple[np.typing.NDArray[np.uint16], np.typing.NDArray[np.uint8], np.typing.NDArray[np.uint8]]:
    labels = np.zeros((SIZE, SIZE), np.uint8)
    for number, (x, y, along) in enumerate(bars, 1):
        corners = cv2.boxPoints(((x, y), (_LENGTH, _WIDTH), 22.5 * along))
        cv2.fillPoly(labels, [np.rint(corners).astype(np.int32)], number)
    height = np.where(labels > 0, _HEIGHT_M, 0).astype(np.float32)
    color = rng.integers(1, 256, (len(bars) + 1, 3), np.uint8)[labels]
    return pack_height(height), color, labels
