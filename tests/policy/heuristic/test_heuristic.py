import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy import make_policy
from policy.heuristic.policy import CLEAR_GRASP
from robotcell.config import CameraMount, CellConfig, Workspace
from robotcell.errors import ConfigError, NoTarget
from robotcell.geometry import rg2
from robotcell.jobs.policy_api import Observation, PickAny, PickGoal, Uncover
from robotcell.motion.grasp import Grasp, grasp_height
from robotcell.motion.push import Push
from robotcell.perception.colors import PALETTE
from robotcell.perception.segmentation import segment
from tests.robotcell.maps import heightmap

CONFIG = CellConfig()
MIDDLE = (-0.5, 0.0)


@pytest.fixture
def policy():
    return make_policy("heuristic", CONFIG)


class Scene:
    """Boxes on a flat table, as a heightmap without noise."""

    def __init__(self, workspace=None):
        self.workspace = workspace or Workspace()
        rows, cols = np.indices(self.workspace.shape)
        self.x, self.y = self.workspace.position(rows, cols)
        self.heights = np.zeros(self.workspace.shape, np.float32)
        self.colors = np.full((*self.workspace.shape, 3), 90, np.uint8)

    def footprint(self, center, size, angle=0.0):
        dx, dy = self.x - center[0], self.y - center[1]
        u, v = dx * math.cos(angle) + dy * math.sin(angle), dy * math.cos(angle) - dx * math.sin(angle)
        return (abs(u) < size[0] / 2) & (abs(v) < size[1] / 2)

    def box(self, center, size=(0.05, 0.05), height=0.05, angle=0.0, color="red"):
        cells = self.footprint(center, size, angle)
        self.heights[cells] = height
        self.colors[cells] = PALETTE[color]
        return cells

    def hide(self, center, size):
        self.heights[self.footprint(center, size)] = np.nan

    def look(self, goal=None, barred=(), *, may_push=True):
        view = replace(heightmap(self.heights, self.workspace), color=self.colors)
        task = PickAny() if goal is None else PickGoal(goal)
        return Observation(view, segment(view).labels, task, barred, may_push)


def packed_goal():
    """A cube that touches a cube of another colour on each side."""
    scene = Scene()
    goal = scene.box(MIDDLE)
    for dx, dy, color in ((0.05, 0, "blue"), (-0.05, 0, "green"), (0, 0.05, "yellow"), (0, -0.05, "gray")):
        scene.box((MIDDLE[0] + dx, MIDDLE[1] + dy), color=color)
    return scene, goal


def test_what_may_not_be_grasped_is_pushed(policy):
    scene = Scene()
    goal = scene.box(MIDDLE)
    scene.box((MIDDLE[0] + 0.05, MIDDLE[1]), color="blue")
    observation = scene.look(goal)
    assert isinstance(policy.decide(observation), Grasp)
    assert isinstance(policy.decide(replace(observation, task=Uncover(goal))), Push)


def finger_cells(scene, action):
    """Cells under the open fingers."""
    reach = (CONFIG.gripper.preshape_m + rg2.FINGER_THICKNESS_M) / 2
    under = np.zeros(scene.heights.shape, bool)
    for side in (reach, -reach):
        center = (action.x + side * math.cos(action.theta), action.y + side * math.sin(action.theta))
        under |= scene.footprint(center, (rg2.FINGER_THICKNESS_M, rg2.FINGER_BREADTH_M), action.theta)
    return under


@settings(max_examples=40)
@given(
    x=st.floats(-0.65, -0.35),
    y=st.floats(-0.15, 0.15),
    angle=st.floats(0, math.pi),
    height=st.floats(0.025, 0.1),
)
def test_a_lone_cube_is_grasped_square_and_in_the_middle(x, y, angle, height):
    scene = Scene()
    scene.box((x, y), height=height, angle=angle)
    action = make_policy("heuristic", CONFIG).decide(scene.look())
    assert isinstance(action, Grasp)
    assert CLEAR_GRASP <= action.q_value <= 1
    assert math.hypot(action.x - x, action.y - y) < 0.012
    askew = (action.theta - angle + math.pi / 4) % (math.pi / 2) - math.pi / 4
    assert abs(askew) <= math.pi / 16 + 0.09  # half a step of 22.5 degrees, and what the cells blur
    assert action.surface_m == pytest.approx(height, abs=1e-3)


@given(angle=st.floats(0, math.pi))
@settings(max_examples=20)
def test_a_plank_is_grasped_across(angle):
    scene = Scene()
    scene.box(MIDDLE, size=(0.1, 0.04), height=0.025, angle=angle)
    action = make_policy("heuristic", CONFIG).decide(scene.look())
    across = abs(math.sin(action.theta - angle))
    assert isinstance(action, Grasp)
    assert across > math.cos(math.radians(20))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**16), count=st.integers(2, 12))
def test_fingers_only_come_down_where_nothing_stands(seed, count):
    scene, rng = Scene(), np.random.default_rng(seed)
    for _ in range(count):
        scene.box(
            rng.uniform((-0.6, -0.1), (-0.4, 0.1)),
            size=rng.uniform(0.025, 0.06, 2),
            height=rng.uniform(0.025, 0.06),
            angle=rng.uniform(0, np.pi),
            color=str(rng.choice(list(PALETTE))),
        )
    try:
        action = make_policy("heuristic", CONFIG).decide(scene.look(may_push=False))
    except NoTarget:
        return
    tips = grasp_height(action.surface_m, CONFIG) + rg2.tip_retraction(CONFIG.gripper.preshape_m)
    assert scene.heights[finger_cells(scene, action)].max(initial=0) < tips


def test_a_packed_goal_is_pushed_free(policy):
    scene, goal = packed_goal()
    action = policy.decide(scene.look(goal))
    assert isinstance(action, Push)
    assert scene.heights[Workspace().cell(*action.start)] == 0
    assert action.top_m == pytest.approx(0.05, abs=0.005)
    way = np.linspace(action.start, action.end, 50)
    assert any(scene.heights[Workspace().cell(x, y)] > 0 for x, y in way)


def test_no_push_where_none_is_allowed(policy):
    scene, goal = packed_goal()
    with pytest.raises(NoTarget, match="no grasp fits"):
        policy.decide(scene.look(goal, may_push=False))


def test_only_the_goal_is_grasped(policy):
    scene = Scene()
    scene.box((-0.58, 0.05), color="blue")
    goal = scene.box((-0.42, -0.06), color="red", height=0.03, angle=0.3)
    action = policy.decide(scene.look(goal))
    assert isinstance(action, Grasp)
    assert goal[Workspace().cell(action.x, action.y)]


@pytest.mark.parametrize("packed", [False, True])
def test_what_failed_is_not_repeated(policy, packed):
    scene, goal = packed_goal()
    if not packed:
        scene = Scene()
        goal = scene.box(MIDDLE)
    barred = ()
    for _ in range(4):
        action = policy.decide(scene.look(goal, barred))
        for old in barred:
            if type(action) is not type(old):
                continue
            grasps = isinstance(action, Grasp)
            places = [(a.x, a.y) if grasps else a.start for a in (action, old)]
            period = 8 if grasps else 16
            turn = (action.rotation - old.rotation) % period
            assert not (math.dist(*places) < 0.02 and min(turn, period - turn) <= 1)
        barred = (*barred, action)


def test_a_shadow_that_may_hide_a_neighbour_is_not_floor():
    # Walls leave only the x axis to close along. A camera at a low angle leaves a shadow behind the cube, and what
    # it sees where the shadow ends decides whether a finger may go there.
    policy = make_policy("heuristic", CellConfig(camera=CameraMount(position=(-1.2, 0.0, 0.5))))

    def scene_with(behind):
        scene = Scene()
        goal = scene.box(MIDDLE)
        for side in (-0.047, 0.047):
            scene.box((MIDDLE[0], MIDDLE[1] + side), size=(0.05, 0.04), color="blue")
        if behind:
            scene.box((MIDDLE[0] + 0.08, 0.0), size=(0.05, 0.14), color="green")
        scene.hide((MIDDLE[0] + 0.042, 0.0), (0.035, 0.14))
        return scene, goal

    scene, goal = scene_with(behind=False)
    clear = policy.decide(scene.look(goal, may_push=False))
    assert clear.rotation in {0, 8}
    scene, goal = scene_with(behind=True)
    with pytest.raises(NoTarget):
        policy.decide(scene.look(goal, may_push=False))


def test_an_empty_table_has_no_target(policy):
    with pytest.raises(NoTarget, match="no object is seen"):
        policy.decide(Scene().look())


def test_an_unknown_policy_lists_those_that_exist():
    with pytest.raises(ConfigError, match="no policy is called 'oracle'; there is: grasp-only, heuristic, learned"):
        make_policy("oracle", CONFIG)
    assert make_policy("heuristic", CONFIG).name == "heuristic"
