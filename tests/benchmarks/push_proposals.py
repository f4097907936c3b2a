"""Which pushes are worth predicting: `python -m tests.benchmarks.push_proposals`.

Scenes of training kinds and unseen seeds, where the goal is the object with the fullest border, and the ten of the
suite `challenging`. Pushes are chosen in several ways and predicted; prints how many they are, and what the best of
them promises, on average.
"""

import math
import sys
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from rich.progress import track

from policy.finger_clearance import OpenGripper
from policy.learned.graspability import Graspability
from policy.network.encoding import PUSH, encode
from policy.network.inference import Inference
from policy.network.weights import load_named
from policy.push.candidates import cells_with_start, push_candidates, pushable_cells
from policy.push.line import free_to_descend, push_line
from policy.push.outcome import PushForwardModel
from policy.training.environment import PushGraspEnv
from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.motion.rotations import ROTATIONS
from robotcell.perception.goals import find_goal
from robotcell.perception.heightmap import Heightmap
from sim_twin.scenes.catalog import scene_names

KINDS = ("enclosed", "packed")
SCENES = 60
MANY = 200
FIRST_SEED = 730_000
# Objects in a scene.
COUNT = (4, 13)

CONFIG = load_config()
RESOLUTION_M, PUSH_M = CONFIG.workspace.resolution_m, CONFIG.motion.push_m
GRIPPER = OpenGripper.of(CONFIG)


class View(NamedTuple):
    """What is seen, the object in each cell (H, W), and the label of the goal."""

    heightmap: Heightmap
    labels: npt.NDArray[np.int32]
    goal: int


def training(kind: str) -> Iterator[View]:
    """Of scenes of a training kind."""
    env = PushGraspEnv(CONFIG, 2)
    for seed in range(FIRST_SEED, FIRST_SEED + SCENES):
        count = int(np.random.default_rng(seed).integers(*COUNT))
        env.reset(seed=seed, options={"kind": kind, "count": count})
        state = env.state
        if state.occupied:
            goal = max(state.occupied, key=lambda label: state.occupied[label])
            yield View(state.heightmap, state.labels.astype(np.int32), goal)
    env.close()


def challenging() -> Iterator[View]:
    """Of the suite `challenging`, the goal the red one."""
    for name in scene_names():
        if not name.startswith("challenging"):
            continue
        config = load_config(None, {"backend.options.scene": name})
        with open_cell(config) as cell:
            view = cell.look()
        heightmap, seen = view.heightmap, view.segmentation
        yield View(heightmap, seen.labels, find_goal(seen, "red").label)


def promises(view: View, inference: Inference, rng: np.random.Generator) -> dict[str, list[float]]:
    """What pushes promise, by the way they were chosen."""
    heightmap, labels, goal = view
    height_m = heightmap.closed_m
    targets = labels == goal
    mask = pushable_cells(targets, labels > 0, RESOLUTION_M)
    free = free_to_descend(height_m, CONFIG.workspace)
    q = inference.maps(encode(height_m, heightmap.color), mask, PUSH)
    model = PushForwardModel(labels, heightmap)
    graspability = Graspability(inference, model, labels, heightmap, GRIPPER)

    def promise(line, rotation):
        return graspability.after(goal, model.height_around(goal, model.predict(line, rotation)))

    def proposed(middle, off_center_m):
        possible = cells_with_start(mask, middle, free, PUSH_M, RESOLUTION_M, off_center_m)
        chosen = push_candidates(q, possible, middle, height_m, free, PUSH_M, RESOLUTION_M, lanes=1)
        return [promise(push.line, push.rotation) for push in chosen]

    cells = np.argwhere(mask)
    drawn = []
    for _ in range(4 * MANY):
        row, col = cells[rng.integers(len(cells))].tolist()
        rotation = int(rng.integers(ROTATIONS))
        line = push_line(height_m, free, (row, col), rotation, PUSH_M, RESOLUTION_M)
        if line is not None:
            drawn.append(promise(line, rotation))
        if len(drawn) == MANY:
            break
    # Where each cell is the middle that its push is for, none is beside it.
    itself = np.stack(np.indices(mask.shape), axis=-1).astype(np.float64)
    middle = np.broadcast_to(np.argwhere(targets).mean(axis=0), itself.shape)
    return {
        "at random": drawn[:ROTATIONS],
        "the best Q of each rotation": proposed(itself, math.inf),
        "the same, less beside the middle": proposed(middle, math.inf),
        "the same, near the middle": proposed(middle, 0.016),
        "many at random": drawn,
    }


def main() -> None:
    """Print a table of each kind."""
    inference, rng = Inference(load_named("learned")[0]), np.random.default_rng(0)
    for kind, views in (("challenging", challenging()), *((kind, training(kind)) for kind in KINDS)):
        best, count = defaultdict(list), defaultdict(list)
        for view in track(views, kind, total=SCENES if kind in KINDS else 10):
            for name, found in promises(view, inference, rng).items():
                best[name].append(max(found, default=0.0))
                count[name].append(len(found))
        for name, values in best.items():
            sys.stdout.write(f"{kind}: {name}: {np.mean(count[name]):.0f} pushes, best promise {np.mean(values):.2f}\n")


if __name__ == "__main__":
    main()
