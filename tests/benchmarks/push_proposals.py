"""Which pushes are worth playing ahead: `python -m tests.benchmarks.push_proposals`.

Scenes of training kinds and unseen seeds. Pushes of the object with the fullest border are chosen in several ways and
played; prints how many they are, and what the best of them promises, on average.
"""

import sys
from collections import defaultdict

import numpy as np
from rich.progress import track

from policy.encoding import encode
from policy.foresight import Foresight
from policy.grasping import Jaw
from policy.inference import Inference
from policy.network import PUSH
from policy.prospects import Prospects
from policy.push_line import push_line
from policy.selection import push_mask, pushes
from policy.training.environment import PushGraspEnv
from policy.weights import load_named
from robotcell.config import load_config
from robotcell.decision import ROTATIONS

KINDS = ("enclosed", "packed")
SCENES = 60
MANY = 200
FIRST_SEED = 730_000
# Objects in a scene.
COUNT = (4, 13)

CONFIG = load_config()
RESOLUTION_M, PUSH_M = CONFIG.workspace.resolution_m, CONFIG.motion.push_m
JAW = Jaw(CONFIG.gripper.preshape_m, CONFIG.gripper.tip_clearance_m)


def promises(env: PushGraspEnv, inference: Inference, rng: np.random.Generator) -> dict[str, list[float]]:
    """What pushes promise, by the way they were chosen."""
    state = env.state
    goal = max(state.occupied, key=lambda label: state.occupied[label])
    labels, height_m, color = state.labels.astype(np.int32), state.height_m, state.heightmap.color
    targets = labels == goal
    mask = push_mask(targets, labels > 0)
    q = inference.maps(encode(height_m, color), mask, PUSH)
    foresight = Foresight(labels, height_m, RESOLUTION_M)
    prospects = Prospects(inference, foresight, labels, height_m, color, JAW, RESOLUTION_M)

    def promise(line, rotation):
        return prospects.after(goal, foresight.around(goal, foresight.play(line, rotation)))

    def proposed(middle):
        chosen = pushes(q, mask, middle, height_m, state.free, PUSH_M, RESOLUTION_M, lanes=1)
        return [promise(push.line, push.rotation) for push in chosen]

    cells = np.argwhere(mask)
    drawn = []
    for _ in range(4 * MANY):
        row, col = cells[rng.integers(len(cells))].tolist()
        rotation = int(rng.integers(ROTATIONS))
        line = push_line(height_m, state.free, (row, col), rotation, PUSH_M, RESOLUTION_M)
        if line is not None:
            drawn.append(promise(line, rotation))
        if len(drawn) == MANY:
            break
    # Where each cell is the middle that its push is for, none is beside it.
    itself = np.stack(np.indices(mask.shape), axis=-1).astype(np.float64)
    return {
        "at random": drawn[:ROTATIONS],
        "the best Q of each rotation": proposed(itself),
        "the same, less beside the middle": proposed(np.broadcast_to(np.argwhere(targets).mean(axis=0), itself.shape)),
        "many at random": drawn,
    }


def main() -> None:
    """Print a table of each kind."""
    inference, env = Inference(load_named("learned")[0]), PushGraspEnv(CONFIG, 2)
    for kind in KINDS:
        best, count = defaultdict(list), defaultdict(list)
        for seed in track(range(FIRST_SEED, FIRST_SEED + SCENES), kind):
            rng = np.random.default_rng(seed)
            env.reset(seed=seed, options={"kind": kind, "count": int(rng.integers(*COUNT))})
            if not env.state.occupied:
                continue
            for name, found in promises(env, inference, rng).items():
                best[name].append(max(found, default=0.0))
                count[name].append(len(found))
        for name, values in best.items():
            sys.stdout.write(f"{kind}: {name}: {np.mean(count[name]):.0f} pushes, best promise {np.mean(values):.2f}\n")
    env.close()


if __name__ == "__main__":
    main()
