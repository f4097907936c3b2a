"""What tells pushes that make a blocked object graspable from others: `python -m tests.benchmarks.push_ranking`.

Scenes of training kinds and unseen seeds, the gripper on slides. An object that cannot be grasped is pushed in random
ways, each from the same state, and after each the grasp that the policy chooses is tried. Prints, for each way to rank
the pushes of a scene, the area under its ROC and how often the push that it ranks first made the object graspable; and
how often grasps succeed by the value that the policy gives them.
"""

import math
import sys
from collections import defaultdict

import numpy as np
from rich.progress import track

from policy.finger_clearance import OpenGripper
from policy.learned.graspability import Graspability
from policy.learned.policy import LearnedPolicy
from policy.network.encoding import GRASP, PUSH, encode
from policy.network.inference import Inference
from policy.network.weights import load_named
from policy.push.candidates import pushable_cells
from policy.push.line import push_line
from policy.push.outcome import PushForwardModel
from policy.training.environment import Outcome, PushGraspEnv
from policy.training.learner import auc
from robotcell.config import load_config
from robotcell.errors import NoTarget
from robotcell.jobs.policy_api import Observation, PickGoal
from robotcell.motion.rotations import ROTATIONS

KINDS = ("enclosed", "packed")
SCENES = 30
PUSHES = 40
FIRST_SEED = 720_000
# Objects in a scene, and cells that the camera must see of one that is to be pushed.
COUNT = (4, 13)
SEEN_CELLS = 60

CONFIG = load_config()
RESOLUTION_M = CONFIG.workspace.resolution_m
GRIPPER = OpenGripper.of(CONFIG)


class Ranking:
    """Blocked objects, and pushes of each."""

    def __init__(self) -> None:
        self.inference = Inference(load_named("learned")[0])
        self.policy = LearnedPolicy(CONFIG, self.inference, may_push=False)
        self.grasps: list[tuple[float, bool]] = []

    def grasp(self, env: PushGraspEnv, goal: int) -> bool:
        """Whether the grasp that the policy would choose takes the goal."""
        state = env.state
        if not (state.labels == goal).any():
            return False
        labels = state.labels.astype(np.int32)
        try:
            action = self.policy.decide(Observation(state.heightmap, labels, PickGoal(labels == goal), may_push=False))
        except NoTarget:
            return False
        held = goal in env.attempt(GRASP, action.rotation, CONFIG.workspace.cell(action.x, action.y)).held
        self.grasps.append((action.q_value, held))
        return held

    def blocked(self, env: PushGraspEnv, rng: np.random.Generator) -> int | None:
        """An object of which the camera sees enough and that cannot be grasped."""
        seen = [label for label in env.state.occupied if (env.state.labels == label).sum() > SEEN_CELLS]
        return next((int(label) for label in rng.permutation(seen) if not self.grasp(env, int(label))), None)

    def scene(
        self, env: PushGraspEnv, goal: int, rng: np.random.Generator
    ) -> tuple[dict[str, list[float]], list[bool]]:
        """Scores of random pushes by their name, and whether the goal could be grasped after each."""
        state = env.state
        labels, height_m, color = state.labels.astype(np.int32), state.height_m, state.heightmap.color
        mask = pushable_cells(labels == goal, labels > 0, RESOLUTION_M)
        q = self.inference.maps(encode(height_m, color), mask, PUSH)
        model = PushForwardModel(labels, state.heightmap)
        graspability = Graspability(self.inference, model, labels, state.heightmap, GRIPPER)
        cells = rng.permutation(np.argwhere(mask))
        scores, graspable = defaultdict(list), []
        for row, col in cells.tolist():
            rotation = int(rng.integers(ROTATIONS))
            line = push_line(height_m, state.free, (row, col), rotation, CONFIG.motion.push_m, RESOLUTION_M)
            if line is None:
                continue
            with env.aside():
                if env.advance(PUSH, rotation, (row, col)).outcome is not Outcome.PUSHED:
                    continue
                graspable.append(self.grasp(env, goal))
            around_m = model.height_around(goal, model.predict(line, rotation))
            scores["Q"].append(float(q[rotation, row, col]))
            scores["border freed"].append(model.border_gain(goal, around_m))
            scores["promise"].append(graspability.after(goal, around_m))
            if len(graspable) == PUSHES:
                break
        return scores, graspable


def main() -> None:
    """Print the table of each kind, and the grasps by their value."""
    ranking, env = Ranking(), PushGraspEnv(CONFIG, 2)
    for kind in KINDS:
        areas, firsts, shares = defaultdict(list), defaultdict(list), []
        for seed in track(range(FIRST_SEED, FIRST_SEED + SCENES), kind):
            rng = np.random.default_rng(seed)
            env.reset(seed=seed, options={"kind": kind, "count": int(rng.integers(*COUNT))})
            goal = ranking.blocked(env, rng)
            if goal is None:
                continue
            scores, graspable = ranking.scene(env, goal, rng)
            if not 0 < sum(graspable) < len(graspable):
                continue
            shares.append(np.mean(graspable))
            for name, values in scores.items():
                areas[name].append(auc(np.array(values, np.float32), np.array(graspable)))
                firsts[name].append(graspable[int(np.argmax(values))])
        sys.stdout.write(f"{kind}: {len(shares)} blocked objects, {100 * np.mean(shares):.0f} % of pushes help\n")
        for name, found in areas.items():
            error = np.std(firsts[name]) / math.sqrt(len(shares))
            sys.stdout.write(
                f"  {name:12s} area under the ROC {np.mean(found):.2f}, "
                f"the first helps in {100 * np.mean(firsts[name]):.0f} % (+- {100 * error:.0f})\n"
            )
    env.close()
    value, held = (np.array(column) for column in zip(*ranking.grasps, strict=True))
    for low in np.arange(0.0, 1.0, 0.1):
        at = (value >= low) & (value < low + 0.1 if low < 0.85 else True)
        if at.any():
            upper = f"to {low + 0.1:.1f}" if low < 0.85 else "and more"
            sys.stdout.write(f"grasps worth {low:.1f} {upper}: {at.sum()}, {100 * held[at].mean():.0f} % succeed\n")


if __name__ == "__main__":
    main()
