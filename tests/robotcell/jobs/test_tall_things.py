"""A pick beside a post, judged in the world; `python -m tests.benchmarks.tall_scenes` does it for many scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from robotcell.cell import Cell
from robotcell.config import Workspace, load_config
from robotcell.geometry.transforms import make_transform
from robotcell.interfaces import Devices
from robotcell.jobs.job import preview, run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.pictures import draw_preview
from robotcell.motion.clearance import Obstructed
from robotcell.motion.grasp import Grasp
from robotcell.motion.path_check import CheckedPlan
from sim_twin.devices.backend import open_twin
from sim_twin.scenes.meshes import hull
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import block, shape_of
from tests.benchmarks.tall_scenes import COLORS, TALL_COLOR, WatchedArm, Watcher

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.jobs.policy_api import Action, Observation


@dataclass
class OneGrasp:
    """A policy that takes the goal in its middle or beside it, in one direction."""

    rotation: int
    beside_m: float = 0.0
    name: str = "one grasp"
    workspace: Workspace = field(default_factory=Workspace)

    def decide(self, observation: Observation) -> Action:
        rows, cols = np.nonzero(observation.targets())
        x, y = observation.heightmap.workspace.position(float(rows.mean()), float(cols.mean()))
        return Grasp(x, y + self.beside_m, 0.05, self.rotation, 1.0)


def post(x: float, y: float, height: float) -> SceneObject:
    corners = np.array([(a, b, c) for a in (-0.0325, 0.0325) for b in (-0.0325, 0.0325) for c in (-0.5, 0.5)])
    shape = shape_of("post", (hull(corners * (1, 1, height)),))
    return SceneObject("post", shape, TALL_COLOR, make_transform(np.eye(3), (x, y, height / 2)))


def test_a_goal_beside_a_post_is_picked_without_a_touch_and_its_plan_is_drawn(tmp_path: Path) -> None:
    config = load_config(None, {"journal.runs": str(tmp_path)})
    cube = SceneObject("red", block("cube"), COLORS["red"], make_transform(np.eye(3), (-0.5, 0.0, 0.025)))
    twin, world = open_twin(config, Scene("post", (cube, post(-0.5, 0.10, 0.25)), drop=False))
    arm = WatchedArm(twin.devices.arm, config)
    cell = Cell(config, Devices(arm, twin.gripper, twin.camera, twin.clock))
    with Journal(f"sqlite:///{tmp_path}/journal.db") as journal, cell:
        decision, safe = preview(cell, OneGrasp(0), "red")
        assert isinstance(safe, CheckedPlan)
        _, blocked = preview(cell, OneGrasp(4, beside_m=0.03), "red")
        assert isinstance(blocked, Obstructed)
        assert np.hypot(blocked.obstruction.x + 0.5, blocked.obstruction.y - 0.1) < 0.07
        plain, crossed = (draw_preview(decision, plan, config, "dry run") for plan in (safe, blocked))
        assert plain.shape == crossed.shape
        assert (plain != crossed).any()
        watcher = Watcher(world, arm)
        world.add_controller(watcher.look)
        report = run_job(cell, OneGrasp(0), journal, ("red",))
        assert report.completed
        assert watcher.violations == set()
        assert world.in_bin(0)
