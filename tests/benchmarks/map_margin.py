"""How far a copy of the map must reach beyond the cells in question: `python -m tests.benchmarks.map_margin RUN`.

RUN is a stage of a training run (`runs/train/stage1`). Prints, for copies that show more or less, how well the Q values
of the shipped weights tell rewarded from unrewarded attempts: the area under the ROC.
"""

import sys
from pathlib import Path

import numpy as np
from rich.progress import track

from policy.network.encoding import GRASP, PUSH, encode
from policy.network.inference import Inference
from policy.network.weights import load_named
from policy.training.learner import auc
from policy.training.shard import Shard, unpack_height

MARGINS_M = (0.048, 0.064, 0.080, 0.112)
SHARDS = 16
ATTEMPTS = 40
# Reward of stage II from which on an attempt counts as a success: a grasp gives 1, a push that frees its object 0.5.
SUCCESS = 0.3


def main() -> None:
    """Print a row of each primitive."""
    paths = sorted((Path(sys.argv[1]) / "shards").glob("*.npz"))
    if not paths:
        sys.exit(f"{sys.argv[1]}/shards holds no shard: name a stage of a training run")
    weights, rng = load_named("learned")[0], np.random.default_rng(0)
    networks = {margin_m: Inference(weights, margin_m) for margin_m in MARGINS_M}
    for name, primitive in (("grasps", GRASP), ("pushes", PUSH)):
        rewarded: list[bool] = []
        values: dict[float, list[float]] = {margin_m: [] for margin_m in MARGINS_M}
        for path in track(paths[:: max(1, len(paths) // SHARDS)], name):
            shard = Shard.load(path)
            for i in rng.permutation(np.flatnonzero(shard.primitive == primitive))[:ATTEMPTS]:
                state, row, col = shard.state[i], shard.row[i], shard.col[i]
                target = shard.labels[state] == shard.target[i]
                if not target[row, col]:
                    continue
                planes = encode(unpack_height(shard.height[state]), shard.color[state])
                rewarded.append(bool(shard.reward[i, 1] > SUCCESS))
                for margin_m, found in values.items():
                    found.append(float(networks[margin_m].maps(planes, target, primitive)[shard.rotation[i], row, col]))
        areas = ", ".join(
            f"{1000 * margin_m:g} mm {auc(np.array(found), np.array(rewarded)):.3f}"
            for margin_m, found in values.items()
        )
        sys.stdout.write(f"{name}: {len(rewarded)} attempts, {areas}\n")


if __name__ == "__main__":
    main()
