"""How fast labelled attempts are collected: `python -m tests.benchmarks.collection`.

Scenes of ten objects, everything included: building and dropping, rendering, heightmaps, attempts. Targets: 12 attempts
a second with one worker, and 1.7 times as many with two on two cores.
"""

import sys
import time

import numpy as np

from policy.rollouts import run_tasks
from policy.training.collect import Collection, SceneKind, collect
from policy.training.config import CollectSettings
from policy.training.environment import Outcome
from policy.training.shard import Shard

SCENES = 16
FIRST_SEED = 1_400_000
SETTINGS = CollectSettings(grasps=12, pushes=4)


def ten_objects(seed: int) -> Shard:
    """One scene of ten dropped objects."""
    return collect(Collection(1, (seed,), None, 1.0, SETTINGS, (SceneKind("drop", 10, 10, 1.0),)))


def attempts(shard: Shard) -> int:
    """Attempts that were simulated: a push is one however many objects it tells of, one without a start is none."""
    made = shard.outcome != Outcome.NO_START
    # The last of a state is simulated again to go on with it, and has the same columns.
    columns = np.stack([shard.state, shard.primitive, shard.rotation, shard.next_state])[:, made]
    pushes = columns[1] == 1
    return int((~pushes).sum()) + len(np.unique(columns[:, pushes], axis=1).T)


def rate(workers: int) -> tuple[float, int]:
    """Attempts a second, the start of two workers included."""
    seeds = range(FIRST_SEED, FIRST_SEED + SCENES)
    started = time.perf_counter()
    shards = [shard for _, shard in run_tasks(ten_objects, seeds, workers)]
    seconds = time.perf_counter() - started
    count = sum(attempts(shard) for shard in shards)
    return count / seconds, count


def main() -> None:
    """Print the rates with one and with two workers."""
    ten_objects(FIRST_SEED)  # imports
    one, count = rate(1)
    two, _ = rate(2)
    sys.stdout.write(f"{count} attempts: {one:.1f}/s with one worker, {two:.1f}/s with two, {two / one:.2f} times\n")


if __name__ == "__main__":
    main()
