"""Picks blocks among bottles, posts and boxes of 0.1 to 0.6 m.

Run `python -m tests.benchmarks.tall_scenes --scenes 200 --seed 0`.

What counts happens in the world, not in the robot's belief: in every physics step the engine says which link of arm or
gripper touches which object. Contact is meant while the arm moves at the guarded speed, while it stands and its fingers
move, and while it is lifted straight up from there; then fingers may touch, and the gripper's body what they touch.
With what they hold they may stay in contact. Every other contact is a violation.

A goal has a way if one of the eight directions of a grasp in its middle has a plan by the true shapes of all objects
(not by what the camera sees), the fingers coming down beside it on nothing, and the goal fitting between them. Pushes,
which could make a way, are not counted.

Rows go to a file, one per goal; a run that was ended goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from policy import make_policy
from robotcell.cell import Cell
from robotcell.config import load_config
from robotcell.errors import CellError, UnsafeMotion
from robotcell.geometry import bodies
from robotcell.geometry.transforms import make_transform, rotation_z, transform_points
from robotcell.interfaces import Devices
from robotcell.jobs.job import run_job
from robotcell.jobs.journal import Journal
from robotcell.motion.grasp import Grasp, grasp_height
from robotcell.motion.rotations import GRASP_ROTATIONS
from robotcell.motion.tool import tool_down
from robotcell.motion.way import plan_way
from robotcell.perception.clearance_map import RESOLUTION_M, ClearanceMap
from sim_twin.devices.backend import open_twin
from sim_twin.scenes.meshes import hull
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import block, shape_of
from sim_twin.world import robot_model
from tests.robotcell.maps import heightmap

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import ArmState
    from sim_twin.scenes.shapes import Shape
    from sim_twin.world.world import World

COLORS = {"red": (255, 60, 60), "green": (60, 170, 70), "yellow": (235, 200, 40)}
TALL_COLOR = (78, 121, 167)
# Contacts that press with less are rounding of the engine [N].
TOUCH_N = 0.2
# A tcp this far to the side has left the line straight up [m].
LINE_M = 0.010
GOAL_SHAPES = ("cube", "cylinder", "hexagonal_slab", "tall_block")


def tall_shape(rng: np.random.Generator) -> Shape:
    """A bottle, a post or a box, 0.1 to 0.6 m high."""
    kind = ("bottle", "post", "box")[rng.integers(3)]
    height = rng.uniform(0.10, {"bottle": 0.35, "post": 0.60, "box": 0.40}[kind])
    if kind == "bottle":
        angle = np.arange(16) * np.pi / 8
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        radius, neck = rng.uniform(0.030, 0.045), 0.014
        rings = ((radius, 0.0), (radius, 0.65 * height), (neck, 0.8 * height), (neck, height))
        points = np.vstack([np.column_stack([r * ring, np.full(16, z)]) for r, z in rings])
    else:
        x, y = rng.uniform(0.04, 0.07, 2) if kind == "post" else rng.uniform(0.08, 0.15, 2)
        points = np.array([(a * x / 2, b * y / 2, c * height) for a in (-1, 1) for b in (-1, 1) for c in (0, 1)])
    return shape_of(f"{kind} {height:.2f}", (hull(points - (0, 0, height / 2)),))


def tall_scene(rng: np.random.Generator, config: CellConfig) -> Scene:
    """One to three goals, and one to three tall things beside or between them, none of which touches another."""
    workspace, table = config.workspace, config.table.height_m
    placed: list[tuple[float, float, float]] = []
    objects: list[SceneObject] = []

    def put(shape: Shape, name: str, color: tuple[int, int, int], near: tuple[float, float] | None) -> None:
        vertices = shape.mesh.vertices
        radius = float(np.linalg.norm(vertices[:, :2], axis=1).max())
        for _ in range(200):
            if near is None:
                x, y = (rng.uniform(low + 0.05, high - 0.05) for low, high in (workspace.x, workspace.y))
            else:
                angle, away = rng.uniform(-np.pi, np.pi), radius + rng.uniform(0.03, 0.12)
                x, y = near[0] + away * np.cos(angle), near[1] + away * np.sin(angle)
            inside = all(low + 0.02 < v < high - 0.02 for v, (low, high) in ((x, workspace.x), (y, workspace.y)))
            if inside and all(np.hypot(x - a, y - b) > radius + r + 0.004 for a, b, r in placed):
                break
        else:
            return
        placed.append((x, y, radius))
        z = table - float(vertices[:, 2].min())
        T = make_transform(rotation_z(rng.uniform(-np.pi, np.pi)), (x, y, z))
        objects.append(SceneObject(name, shape, color, T))

    for color in list(COLORS)[: rng.integers(1, 4)]:
        put(block(GOAL_SHAPES[rng.integers(len(GOAL_SHAPES))]), color, COLORS[color], None)
    goals = list(placed)
    for i in range(rng.integers(1, 4)):
        near = goals[rng.integers(len(goals))][:2] if rng.random() < 0.8 else None
        put(tall_shape(rng), f"tall {i}", TALL_COLOR, near)
    return Scene("tall", tuple(objects), drop=False)


class WatchedArm:
    """The twin's arm, and the notes of what its motions are for, by the commands that it gets."""

    def __init__(self, arm: Any, config: CellConfig) -> None:
        self._arm = arm
        self._guarded_m_s = config.motion.guarded_speed_m_s
        # Whether contact of the fingers is meant now: in a guarded motion, after it, and straight up from there.
        self.contact_is_meant = False
        self.leaves = False
        self.label = "stands"
        self._from, self._guarded_below_m = np.zeros(2), -1.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def state(self) -> ArmState:
        return self._arm.state()  # type: ignore[no-any-return]

    def start_path(self, waypoints: Any) -> None:
        """A motion of several legs: from contact straight up, or down into a guarded leg after the leg before it."""
        self._from = self._arm.state().T_base_tcp[:2, 3]
        guarded = getattr(waypoints[-1], "speed_m_s", None) == self._guarded_m_s
        before = waypoints[-2] if guarded and len(waypoints) > 1 else None
        self._guarded_below_m = before.T_base_tcp[2, 3] if hasattr(before, "T_base_tcp") else -1.0
        alone = guarded and before is None
        self.leaves = self.contact_is_meant and not guarded
        self.contact_is_meant = alone or self.leaves
        self.label = "guarded motion" if alone else "blended motion"
        self._arm.start_path(waypoints)

    def follow(self) -> None:
        """Contact is meant no longer once a blended motion has left the line straight up."""
        if self.label == "blended motion" and self._arm.state().T_base_tcp[2, 3] < self._guarded_below_m:
            self.contact_is_meant, self.label = True, "guarded motion"
        if self.label == "blended motion" and self.leaves:
            away = float(np.hypot(*(self._arm.state().T_base_tcp[:2, 3] - self._from)))
            self.leaves = self.contact_is_meant = away < LINE_M


class Watcher:
    """Looks at every physics step for contacts of arm and gripper with objects."""

    def __init__(self, world: World, arm: WatchedArm) -> None:
        self._world, self._arm = world, arm
        self._held: set[int] = set()
        self._meant = False
        self.violations: set[str] = set()

    def look(self) -> None:
        simulation = self._world.simulation
        contacts = simulation.engine.getContactPoints(bodyA=simulation.robot, physicsClientId=simulation.client)
        touched = {(c[3], c[2], c[9] > TOUCH_N) for c in contacts if c[2] in simulation.bodies}
        self._arm.follow()
        if self._arm.contact_is_meant:
            # What fingers touched in this part is what the action is for, or lies beside it.
            fresh = {body for link, body, _ in touched if self._is_finger(link)}
            self._held = fresh if not self._meant else self._held | fresh
        self._meant = self._arm.contact_is_meant
        for link, body, presses in touched:
            if not presses or (self._is_finger(link) and (self._arm.contact_is_meant or body in self._held)):
                continue
            names = {index: name for name, index in simulation.joints.items()}
            thing = self._world.objects()[simulation.bodies.index(body)][0]
            # The palm may meet what the fingers hold or push.
            if body in self._held and names[link] == "flange":
                continue
            self.violations.add(f"{names[link]} touched {thing.name} ({thing.shape.name}) in a {self._arm.label}")

    def _is_finger(self, link: int) -> bool:
        joints = self._world.simulation.joints
        return link in {joints[n] for n in (robot_model.LEFT_CRANK, robot_model.LEFT_FINGER)} | {
            joints[n] for n in (robot_model.RIGHT_CRANK, robot_model.RIGHT_FINGER)
        }


def true_map(objects: list[tuple[SceneObject, Array]], config: CellConfig, without: str | None = None) -> ClearanceMap:
    """The map of clearance by the true shapes: the tops of the objects' convex parts, each seen from above."""
    origin, shape = (-0.95, -0.70), (280, 200)
    ceiling = np.zeros(shape, np.float32)
    for item, T in objects:
        if item.name == without:
            continue
        for part in item.shape.parts:
            points = transform_points(T, part.vertices)
            outline = cv2.convexHull(((points[:, :2] - origin) / RESOLUTION_M).astype(np.float32))
            inside = np.zeros(shape, np.uint8)
            cv2.fillConvexPoly(inside, np.rint(outline * 16).astype(np.int32), 1, shift=4)
            ceiling[inside > 0] = np.maximum(ceiling[inside > 0], float(points[:, 2].max()) - config.table.height_m)
    everywhere = np.ones(shape, np.bool_)
    return ClearanceMap(origin, ceiling, everywhere, ~everywhere, config.table.height_m)


def has_way(objects: list[tuple[SceneObject, Array]], goal: str, config: CellConfig) -> bool:
    """Whether a grasp of a goal has a plan by the true shapes."""
    item, T = next((o, T) for o, T in objects if o.name == goal)
    points = transform_points(T, item.shape.mesh.vertices)
    x, y = T[:2, 3]
    top = float(points[:, 2].max()) - config.table.height_m
    everything, others = true_map(objects, config), true_map(objects, config, goal)
    opening = config.gripper.preshape_m
    shape = bodies.tool_points(opening, 0.0)
    fingers = shape.points[~shape.body]
    flat, home = heightmap(np.full(config.workspace.shape, top, np.float32)), np.array(config.motion.home_q)
    for rotation in range(GRASP_ROTATIONS):
        grasp = Grasp(float(x), float(y), top, rotation, 1.0)
        along = points[:, :2] @ (np.cos(grasp.theta), np.sin(grasp.theta))
        if np.ptp(along) > opening - 0.006:
            continue
        T_tcp = tool_down(grasp.x, grasp.y, config.table.height_m + grasp_height(top, config), grasp.theta)
        around = transform_points(T_tcp, fingers)
        if others.gaps(around, np.full(len(around), shape.radius_m - 0.004), 0.0, 0.01).min() < 0:
            continue
        try:
            plan_way(grasp, flat, everything, home, config)
        except UnsafeMotion:
            continue
        return True
    return False


def run_scene(seed: int, index: int, policy_name: str) -> list[dict[str, Any]]:
    """Pick the goals of a scene, a job for each; a row for each of them."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        config = load_config(None, {"journal.runs": folder, "policy.name": policy_name})
        scene = tall_scene(np.random.default_rng([seed, index]), config)
        policy = make_policy(policy_name, config)
        twin, world = open_twin(config, scene)
        arm = WatchedArm(twin.devices.arm, config)
        cell = Cell(config, Devices(arm, twin.gripper, twin.camera, twin.clock))
        with Journal(f"sqlite:///{folder}/journal.db") as journal, cell:
            for goal in [o.name for o in scene.objects if o.name in COLORS]:
                objects = world.objects()
                number = [o.name for o, _ in objects].index(goal)
                way = has_way(objects, goal, config)
                watcher = Watcher(world, arm)
                world.add_controller(watcher.look)
                try:
                    report = run_job(cell, policy, journal, (goal,))
                    reason = report.reason
                except CellError as error:
                    reason = f"{type(error).__name__}: {error}"
                world.remove_controller(watcher.look)
                picked = world.in_bin(number)
                rows.append(
                    {
                        "scene": index,
                        "goal": goal,
                        "tall": [o.shape.name for o, _ in objects if o.name not in COLORS],
                        "way": way,
                        "picked": picked,
                        "stopped": cell.latch.violation is not None,
                        "violations": sorted(watcher.violations),
                        "reason": reason,
                    }
                )
                if cell.latch.violation is not None:
                    break
    return rows


def summary(rows: list[dict[str, Any]]) -> str:
    """The figures of all rows in a line."""
    scenes = {row["scene"] for row in rows}
    touched = {row["scene"] for row in rows if row["violations"]}
    stopped = {row["scene"] for row in rows if row["stopped"]}
    ways = [row for row in rows if row["way"]]
    picked = sum(row["picked"] for row in ways)
    share = picked / len(ways) if ways else 1.0
    return (
        f"{len(scenes)} scenes: {len(touched)} with a contact outside the guarded parts, {len(stopped)} stopped; "
        f"{picked} of {len(ways)} goals with a way picked ({share:.0%}), "
        f"{sum(row['picked'] for row in rows)} of {len(rows)} in all"
    )


def main() -> None:
    """Run the scenes that are not in the file yet, and print the figures of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--policy", default="learned")
    parser.add_argument("--part", default="0/1", help="i/n: only every n-th scene, from the i-th")
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    part, parts = (int(n) for n in options.part.split("/"))
    out = options.out or Path("runs") / f"tall-scenes-{options.policy}-{options.seed}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    done = {row["scene"] for row in rows}
    for index in range(part, options.scenes, parts):
        if index in done:
            continue
        new = run_scene(options.seed, index, options.policy)
        rows += new
        with out.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in new)
        sys.stdout.write(f"{index + 1}/{options.scenes}  {summary(rows)}\n")
        sys.stdout.flush()
    sys.stdout.write(summary(rows) + "\n")


if __name__ == "__main__":
    main()
