"""The task as a Gymnasium environment over the twin: heightmaps in, grasps and pushes out, the paper's rewards.

The machine is the gripper on slides (`sim_twin.devices.gantry`), so an attempt costs a tenth of what the arm
needs. What is random of the cell (camera, colours, friction, masses, sizes) is drawn anew for each scene from its seed.
"""

from __future__ import annotations

import enum
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import gymnasium
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from policy.learned.selection import surface_at
from policy.map_grid import workspace_at
from policy.network.encoding import CHANNELS, GRASP, PUSH, RESOLUTION_M, encode
from policy.push.border import USEFUL_GAIN, border_occupancy
from policy.push.line import PushLine, free_to_descend, push_line
from policy.training.scenes import training_scene
from robotcell.config import CameraMount, CellConfig
from robotcell.config.fingers import closed_width
from robotcell.errors import ConfigError
from robotcell.geometry.transforms import look_at, make_transform
from robotcell.motion.executor import Ending
from robotcell.motion.grasp import grasp_height
from robotcell.motion.push import push_height
from robotcell.motion.rotations import GRASP_ROTATIONS, ROTATIONS, rotation_angle_rad
from robotcell.motion.tool import near_height
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.heightmap import Heightmap, build_heightmap
from robotcell.perception.segmentation import MIN_OBJECT_M
from sim_twin.devices.camera import TwinCamera
from sim_twin.devices.gantry import GantryGripper
from sim_twin.options import NoiseOptions, TwinOptions
from sim_twin.world.bodies import Friction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.geometry.transforms import Array

# Paper, stage II: the reward of a push that frees more than tau of the border (`policy.push.border.USEFUL_GAIN`).
PUSH_REWARD = 0.5
# Stage I: a push scatters when the objects' borders are freed by this much on average over all that moved.
_SCATTER = 0.02
_MOVED_M = 0.005
# Labels of up to 63 objects travel through the heightmap as one mask for each binary digit.
_BITS = 6
# A scene that does not come to rest is drawn again.
_SCENE_TRIES = 5

# Spread of the camera's place and of the point it looks at [m], and of the error of its calibration.
_CAMERA_SPREAD_M = 0.03
_CALIBRATION_M = 0.0007
_CALIBRATION_RAD = 0.0015
_FRICTION_OBJECTS = (0.6, 1.0)
_FRICTION_TABLE = (0.45, 0.75)

Cell = tuple[int, int]


class Outcome(enum.IntEnum):
    """What an attempt came to."""

    PICKED = 0
    OTHER_OBJECT = 1  # held, but not the one that the cell belongs to
    EMPTY = 2
    LOST = 3
    COLLIDED = 4
    PUSHED = 5
    NO_START = 6  # nowhere for the closed fingers to come down


@dataclass(frozen=True)
class State:
    """What the camera saw, and what is really there.

    Attributes:
        heightmap: with the camera's noise.
        height_m: (H, W) its heights with closed gaps, NaN where unknown.
        labels: (H, W) uint8 true object of each cell, its index + 1; 0 = none.
        free: (H, W) where closed fingers can come down.
        occupied: share of each object's border that something stands on, by label.
    """

    heightmap: Heightmap
    height_m: npt.NDArray[np.float32]
    labels: npt.NDArray[np.uint8]
    free: npt.NDArray[np.bool_]
    occupied: dict[int, float]


@dataclass(frozen=True)
class Trial:
    """An attempt and what came of it.

    Attributes:
        outcome: in a word.
        held: labels of what the fingers took.
        rows: what the learner is told, one row per object concerned: cell, target label, rewards (stage I, stage II),
            and whether the episode goes on.
        after: the state after a push.
    """

    outcome: Outcome
    held: tuple[int, ...]
    rows: tuple[tuple[Cell, int, tuple[float, float], bool], ...]
    after: State | None = None


class PushGraspEnv(gymnasium.Env[npt.NDArray[np.float32], npt.NDArray[np.int64]]):
    """Push and grasp until the table is clear (stage I) or the goal is picked (stage II).

    Observations are encoded heightmaps (`policy.network.encoding`), actions (primitive, rotation, row, col); a grasp
    has eight rotations, so `rotation` counts modulo 8. `info` holds the labels and the goal's. `attempt` and
    `aside` give what a learner may ask of a simulator beyond that: other actions in the same state.

    Args:
        config: of the cell; its workspace is seen at the resolution of the network.
        stage: 1, goal-agnostic, or 2, goal-oriented.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - the interface's own declaration

    def __init__(self, config: CellConfig, stage: int) -> None:
        config = config.model_copy(update={"workspace": workspace_at(config.workspace, RESOLUTION_M)})
        rows, cols = config.workspace.shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (CHANNELS, rows, cols), np.float32)
        self.action_space = gymnasium.spaces.MultiDiscrete([2, ROTATIONS, rows, cols])
        self._config = config
        self._stage = stage
        self._gripper: GantryGripper | None = None
        self._camera: TwinCamera | None = None
        # The camera's pose as its calibration has it.
        self._T_base_camera: Array = np.eye(4)
        self._state: State | None = None
        self._goal = 0

    @property
    def state(self) -> State:
        """The scene as it stands."""
        if self._state is None:
            raise RuntimeError("reset the environment first")
        return self._state

    @property
    def goal(self) -> int:
        """Label of the goal; 0 in stage I."""
        return self._goal

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """A new scene; `options` may give `kind` ("drop", "packed", "enclosed") and `count` (objects).

        Raises:
            ConfigError: no scene came to rest in the workspace.
        """
        super().reset(seed=seed)
        rng = self.np_random
        options = options or {}
        for attempt in range(_SCENE_TRIES):
            self.close()
            try:
                self._build(str(options.get("kind", "drop")), int(options.get("count", 10)), rng)
                break
            except ConfigError:
                if attempt == _SCENE_TRIES - 1:
                    raise
        self._state = self._look()
        self._choose_goal()
        return self._observation(), self._info()

    def step(self, action: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Run an action (primitive, rotation, row, col); the reward is the stage's."""
        primitive, rotation, row, col = (int(v) for v in action)
        trial = self.advance(primitive, rotation, (row, col))
        label = int(self.state.labels[row, col]) if self._stage == 1 else self._goal
        rewards = [
            reward[self._stage - 1] for _, target, reward, _ in trial.rows if self._stage == 1 or target == label
        ]
        picked = self._goal in trial.held
        if picked:
            self._choose_goal()
        over = picked if self._stage == 2 else not self.state.labels.any()
        return self._observation(), max(rewards, default=0.0), over, False, self._info() | {"outcome": trial.outcome}

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Whatever is done inside is undone at the end: the scene stands as it stood."""
        gripper, state = self._need(), self._state
        saved = gripper.save()
        try:
            yield
        finally:
            gripper.restore(saved)
            self._state = state

    def attempt(self, primitive: int, rotation: int, cell: Cell) -> Trial:
        """What an action would come to; the scene stays as it is."""
        with self.aside():
            return self._run(primitive, rotation, cell)

    def advance(self, primitive: int, rotation: int, cell: Cell) -> Trial:
        """Run an action for good: what was held is taken off the table."""
        gripper = self._need()
        trial = self._run(primitive, rotation, cell)
        if trial.outcome is Outcome.NO_START:
            return trial
        gripper.take(tuple(label - 1 for label in trial.held))
        gripper.withdraw()
        gripper.take(gripper.drop_outs())
        self._state = trial.after if trial.after is not None else self._look()
        return trial

    def close(self) -> None:
        """End the world. Idempotent."""
        if self._camera is not None:
            self._camera.close()
        if self._gripper is not None:
            self._gripper.close()
        self._gripper = self._camera = self._state = None

    def _build(self, kind: str, count: int, rng: np.random.Generator) -> None:
        config = self._config
        spread = rng.normal(0, _CAMERA_SPREAD_M, (2, 3)) * ((1, 1, 1), (1, 1, 0))
        T_base_camera = look_at(
            tuple(np.array(config.camera.position) + spread[0]), tuple(np.array(config.camera.look_at) + spread[1])
        )
        error = make_transform(
            Rotation.from_rotvec(rng.normal(0, _CALIBRATION_RAD / np.sqrt(3), 3)).as_matrix(),
            rng.normal(0, _CALIBRATION_M / np.sqrt(3), 3),
        )
        rows = tuple(tuple(float(v) for v in row) for row in T_base_camera)
        config = config.model_copy(
            update={"camera": CameraMount(resolution=config.camera.resolution, T_base_camera=rows)}
        )
        self._T_base_camera = T_base_camera @ error
        scene = training_scene(kind, count, config, rng)
        options = TwinOptions(seed=int(rng.integers(2**31)), noise=NoiseOptions(warm_up=False))
        friction = Friction(float(rng.uniform(*_FRICTION_OBJECTS)), float(rng.uniform(*_FRICTION_TABLE)))
        self._gripper = GantryGripper(config, options, scene, friction)
        self._gripper.connect()
        self._gripper.take(self._gripper.drop_outs())
        self._camera = TwinCamera(self._gripper.world, config.camera, options)
        self._camera.connect()

    def _look(self) -> State:
        gripper, camera = self._need(), self._camera
        if camera is None:
            raise RuntimeError("reset the environment first")
        frame, visual = camera.read_with_truth()
        index_of = np.array([*(v.object_index + 1 for v in gripper.world.visuals()), 0])
        label = index_of[visual]
        bits = {str(bit): (label >> bit & 1).astype(np.bool_) for bit in range(_BITS)}
        config = self._config
        heightmap = build_heightmap(
            frame, CalibratedCamera(self._T_base_camera), config.workspace, config.table.height_m, bits
        )
        labels = np.zeros(config.workspace.shape, np.uint8)
        for bit in range(_BITS):
            labels |= heightmap.masks[str(bit)].astype(np.uint8) << np.uint8(bit)
        heightmap = replace(heightmap, masks={})
        height_m = heightmap.closed_m
        with np.errstate(invalid="ignore"):
            high = height_m > MIN_OBJECT_M
        labels = np.where(high, np.where(labels == 0, cv2.dilate(labels, np.ones((3, 3), np.uint8)), labels), 0)
        labels = labels.astype(np.uint8)
        return State(
            heightmap=heightmap,
            height_m=height_m,
            labels=labels,
            free=free_to_descend(height_m, config.workspace),
            occupied={int(i): border_occupancy(labels == i, height_m, RESOLUTION_M) for i in np.unique(labels) if i},
        )

    def _run(self, primitive: int, rotation: int, cell: Cell) -> Trial:
        return self._grasp(rotation % GRASP_ROTATIONS, cell) if primitive == GRASP else self._push(rotation, cell)

    def _grasp(self, rotation: int, cell: Cell) -> Trial:
        gripper, state, config = self._need(), self.state, self._config
        table = config.table.height_m
        x, y = config.workspace.position(*cell)
        theta = rotation_angle_rad(rotation)
        tcp_z = table + grasp_height(surface_at(state.height_m, cell, RESOLUTION_M), config)
        near_z = near_height(state.heightmap, x, y, theta, config.gripper.preshape_m, tcp_z, config)
        attempt = gripper.grasp(x, y, theta, near_z, tcp_z)
        target = int(state.labels[cell])
        if attempt.held:
            held = tuple(i + 1 for i in attempt.held)
            outcome = Outcome.PICKED if target in held else Outcome.OTHER_OBJECT
            return Trial(outcome, held, ((cell, target, (1.0, float(target in held)), False),))
        failed = {Ending.EMPTY: Outcome.EMPTY, Ending.CONTACT: Outcome.COLLIDED, Ending.DONE: Outcome.LOST}
        return Trial(failed[attempt.ending], (), ((cell, target, (0.0, 0.0), False),))

    def _push(self, rotation: int, cell: Cell) -> Trial:
        gripper, state, config = self._need(), self.state, self._config
        table, workspace = config.table.height_m, config.workspace
        target = int(state.labels[cell])
        nothing = ((cell, target, (0.0, 0.0), False),)
        line = push_line(state.height_m, state.free, cell, rotation, config.motion.push_m, RESOLUTION_M)
        if line is None:
            return Trial(Outcome.NO_START, (), nothing)
        x, y = workspace.position(line.row, line.col)
        theta = rotation_angle_rad(rotation)
        tcp_z = table + push_height(line.top_m, config)
        near_z = near_height(state.heightmap, x, y, theta, closed_width(config), tcp_z, config)
        length = (len(line.cells) - 1) * RESOLUTION_M
        before = gripper.save()
        attempt = gripper.push((x, y), theta, length, near_z, tcp_z)
        if attempt.ending is Ending.CONTACT:
            return Trial(Outcome.COLLIDED, (), nothing)
        gripper.withdraw()
        moved = _moved(before, gripper.save())
        after = self._look()
        return Trial(Outcome.PUSHED, (), self._push_rows(cell, line, moved, after), after)

    def _push_rows(
        self, cell: Cell, line: PushLine, moved: npt.NDArray[np.intp], after: State
    ) -> tuple[tuple[Cell, int, tuple[float, float], bool], ...]:
        """A row for the chosen cell and one for every other object on the way.

        Cells behind which the fingers could come down nearer belong to another push.
        """
        state = self.state
        gains = {i: state.occupied[i] - after.occupied[i] for i in state.occupied if i in after.occupied}
        freed = [gains[int(i) + 1] for i in moved if int(i) + 1 in gains]
        scatter = PUSH_REWARD if freed and float(np.mean(freed)) > _SCATTER else 0.0
        on_way = state.labels[line.cells[:, 0], line.cells[:, 1]]
        free = state.free[line.cells[:, 0], line.cells[:, 1]]
        met = int(np.argmax(on_way > 0))
        again = np.flatnonzero(free[met:])
        reach = met + int(again[0]) if len(again) else len(on_way)
        rows = []
        for target in dict.fromkeys(int(v) for v in on_way[:reach] if v):
            own = np.flatnonzero(on_way[:reach] == target)
            at = line.cells[own[len(own) // 2]]
            reward = PUSH_REWARD if gains.get(target, 0.0) > USEFUL_GAIN else 0.0
            # The middle of what the push meets, and for the chosen object the cell it was chosen for.
            places = {(int(at[0]), int(at[1]))} | ({cell} if target == int(state.labels[cell]) else set())
            rows += [(place, target, (scatter, reward), target in gains) for place in sorted(places)]
        return tuple(rows)

    def _choose_goal(self) -> None:
        seen = np.unique(self.state.labels)
        seen = seen[seen > 0]
        self._goal = int(self.np_random.choice(seen)) if self._stage == 2 and len(seen) else 0

    def _observation(self) -> npt.NDArray[np.float32]:
        return encode(self.state.height_m, self.state.heightmap.color)

    def _info(self) -> dict[str, Any]:
        return {"labels": self.state.labels.copy(), "goal": self._goal}

    def _need(self) -> GantryGripper:
        if self._gripper is None:
            raise RuntimeError("reset the environment first")
        return self._gripper


def _moved(
    before: list[tuple[tuple[float, ...], tuple[float, ...]]], after: list[tuple[tuple[float, ...], tuple[float, ...]]]
) -> npt.NDArray[np.intp]:
    a, b = (np.array([position for position, _ in saved]) for saved in (before, after))
    return np.flatnonzero(np.linalg.norm(a - b, axis=1) > _MOVED_M)


__all__ = ["GRASP", "PUSH", "Outcome", "PushGraspEnv", "State", "Trial"]
