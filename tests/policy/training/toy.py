"""Scenes of flat bars on a small table, where what succeeds can be read off the picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from policy.training.shard import GRASP, PUSH, Shard, pack_height

if TYPE_CHECKING:
    from policy.training.collect import Collection

SIZE = 32
_HEIGHT_M = 0.05


def collect(collection: Collection) -> Shard:
    """Two states of each scene; a push leads from the first to the second.

    A grasp succeeds near the middle of its bar, across it. A push is rewarded along its bar.
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
                x, y, along = bars[target - 1]
                across = (plane - along) % 8 in (3, 4, 5)
                if primitive == GRASP:
                    reward = float(across and math.hypot(col - x, row - y) < 4)
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
    return [(float(x), float(rng.integers(10, SIZE - 10)), int(rng.integers(8))) for x in (8, SIZE - 9)]


def _draw(
    bars: list[tuple[float, float, int]], rng: np.random.Generator
) -> tuple[np.typing.NDArray[np.uint16], np.typing.NDArray[np.uint8], np.typing.NDArray[np.uint8]]:
    labels = np.zeros((SIZE, SIZE), np.uint8)
    for number, (x, y, along) in enumerate(bars, 1):
        corners = cv2.boxPoints(((x, y), (13.0, 4.0), 22.5 * along))
        cv2.fillPoly(labels, [np.rint(corners).astype(np.int32)], number)
    height = np.where(labels > 0, _HEIGHT_M, 0).astype(np.float32)
    color = rng.integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    return pack_height(height), color, labels
