import numpy as np
import pytest

from calibration.collect.board_motion import plan_motions
from calibration.collect.view_planning import plan_views, visible
from calibration.solve.verdict import MIN_ROTATION_DEG, rotation_spread_deg
from calibration.target.held_board import HeldBoard
from robotcell.config import load_config
from robotcell.errors import UnsafeMotion
from robotcell.geometry import ur5e
from robotcell.geometry.transforms import invert_transform, transform_points
from robotcell.motion.path_check import check_path
from robotcell.motion.tool import TALLEST_OBJECT_M
from robotcell.perception.board_plate import DEFAULT_BOARD, held_by_gripper
from sim_twin.d415.renderer import MODES

CONFIG = load_config(None, {"camera.resolution": "1280x720"})
HELD = HeldBoard(DEFAULT_BOARD, held_by_gripper(DEFAULT_BOARD))
OPTICS = MODES["1280x720"]
HOME = np.array(CONFIG.motion.home_q)


def plan(seed=1, count=14, config=CONFIG, taken=()):
    return plan_views(config, HELD, config.camera.pose(), OPTICS, count, seed, HOME, taken)


@pytest.fixture(scope="module")
def views():
    return plan()


def seen_at(views):
    T_base_flange = ur5e.forward(np.array(views.views))
    return invert_transform(CONFIG.camera.pose()) @ T_base_flange @ HELD.T_flange_board


def test_the_camera_sees_the_whole_board_in_every_view(views):
    assert len(views.views) == 14
    assert all(visible(T, HELD, OPTICS) for T in seen_at(views))


def test_views_differ_in_depth_and_turn_about_all_axes(views):
    T = seen_at(views)
    depths = [transform_points(view, HELD.center)[2] for view in T]
    assert np.ptp(depths) > 0.10
    spread = rotation_spread_deg(ur5e.forward(np.array(views.views)))
    assert spread[2] > 2 * MIN_ROTATION_DEG


def test_every_way_is_safe_and_keeps_the_board_over_what_may_stand_on_the_table(views):
    q = HOME
    for target in views.views:
        for motion in plan_motions("way", q, target, views.q_via, HELD, CONFIG):
            check_path(motion.plan, CONFIG)
            goal = motion.plan.steps[-1].q
            for share in np.linspace(0, 1, 12):
                T = ur5e.forward(motion.plan.q_start + share * (goal - motion.plan.q_start))
                assert transform_points(T, HELD.points)[:, 2].min() > TALLEST_OBJECT_M
            q = goal
        assert np.array_equal(q, target)


def test_a_seed_plans_the_same_views_again_and_another_plans_others():
    first, again, other = plan(count=1), plan(count=1), plan(count=1, seed=2)
    np.testing.assert_array_equal(again.views, first.views)
    assert not np.array_equal(again.views, other.views)


def test_further_views_differ_from_those_that_are_there(views):
    taken = list(seen_at(views))
    more = seen_at(plan(seed=1, count=4, taken=taken))
    nearest = [min(np.linalg.norm(T[:3, 3] - other[:3, 3]) for other in taken) for T in more]
    turned = [min(np.linalg.norm(T[:3, :3] - other[:3, :3]) for other in taken) for T in more]
    assert all(a > 0.02 or b > 0.15 for a, b in zip(nearest, turned, strict=True))


def test_a_camera_that_looks_away_is_refused_with_what_stood_in_the_way():
    config = load_config(None, {"camera.position": [-0.8, 0.0, 0.8], "camera.look_at": [-3.0, 0.0, 0.8]})
    with pytest.raises(UnsafeMotion, match=r"no pose of the arm shows the board.*out of reach"):
        plan(count=3, config=config)


def test_a_board_that_would_hit_something_is_refused():
    low = np.array([-0.0371, -1.2, 2.0, -0.8, 0.0, 0.7])
    with pytest.raises(UnsafeMotion):
        plan_motions("down", HOME, low, HOME, HELD, CONFIG)
