"""The task as an environment."""

import warnings

import gymnasium.utils.env_checker
import numpy as np
import pytest

from policy.training.environment import (
    GRASP,
    PUSH,
    PUSH_REWARD,
    Outcome,
    PushGraspEnv,
)
from robotcell.config import load_config

SEED = 1_500_000


@pytest.fixture
def env():
    env = PushGraspEnv(load_config(), stage=2)
    try:
        env.reset(seed=SEED, options={"kind": "packed", "count": 4})
        yield env
    finally:
        env.close()


def middle(env, label):
    rows, cols = np.nonzero(env.state.labels == label)
    i = int(np.argmin((rows - rows.mean()) ** 2 + (cols - cols.mean()) ** 2))
    return int(rows[i]), int(cols[i])


def test_it_is_an_environment_as_gymnasium_defines_one(request):
    env = PushGraspEnv(load_config(), stage=1)
    request.addfinalizer(env.close)
    with warnings.catch_warnings():
        # It asks for bounds of the observations, which heights and colours of no fixed scale do not have.
        warnings.filterwarnings("ignore", message=".*(infinity|-infinity).*")
        gymnasium.utils.env_checker.check_env(env, skip_render_check=True)


def test_the_same_seed_gives_the_same_scene(request):
    first, second = (PushGraspEnv(load_config(), stage=2) for _ in range(2))
    request.addfinalizer(first.close)
    request.addfinalizer(second.close)
    options = {"kind": "drop", "count": 3}
    (a, a_info), (b, b_info), (c, _) = (
        env.reset(seed=seed, options=options) for env, seed in ((first, SEED), (second, SEED), (second, SEED + 1))
    )
    assert np.array_equal(a, b)
    assert np.array_equal(a_info["labels"], b_info["labels"])
    assert a_info["goal"] == b_info["goal"]
    assert not np.array_equal(a, c)


def test_every_object_is_seen_under_its_own_label(env):
    assert set(env.state.occupied) == {1, 2, 3, 4}
    assert env.goal in env.state.occupied
    heights = env.state.height_m[env.state.labels > 0]
    assert np.nanmin(heights) > 0.010


def test_attempts_leave_the_scene_as_it_is(env):
    before = env.state
    outcomes = [
        [env.attempt(GRASP, k, middle(env, label)).outcome for label in (1, 2) for k in (0, 4)] for _ in range(2)
    ]
    assert outcomes[0] == outcomes[1]
    assert env.state is before
    assert env.state.labels.any()


def test_a_goal_that_is_grasped_is_rewarded_and_leaves_the_table(env):
    for label in sorted(env.state.occupied):
        for k in range(8):
            cell = middle(env, label)
            trial = env.attempt(GRASP, k, cell)
            if trial.outcome is Outcome.PICKED:
                ((place, target, rewards, goes_on),) = trial.rows
                assert (place, target, rewards, goes_on) == (cell, label, (1.0, 1.0), False)
                assert label in env.advance(GRASP, k, cell).held
                assert label not in env.state.occupied
                return
    pytest.fail("no object of the scene could be grasped")


def test_a_step_in_stage_2_ends_with_the_goal(env):
    env.reset(seed=SEED, options={"kind": "drop", "count": 2})
    goal = env.goal
    (other,) = set(env.state.occupied) - {goal}
    _, reward, over, truncated, info = env.step(np.array([GRASP, 0, *middle(env, other)]))
    assert (reward, over, truncated, info["outcome"]) == (0.0, False, False, Outcome.PICKED)
    assert info["goal"] == goal
    _, reward, over, truncated, info = env.step(np.array([GRASP, 0, *middle(env, goal)]))
    assert (reward, over, truncated, info["outcome"]) == (1.0, True, False, Outcome.PICKED)
    assert info["goal"] == 0
    assert not info["labels"].any()


def test_a_push_tells_of_every_object_on_its_way(env):
    seen = []
    for label in sorted(env.state.occupied):
        for k in range(0, 16, 3):
            trial = env.attempt(PUSH, k, middle(env, label))
            seen.append(trial.outcome)
            assert (trial.after is not None) == (trial.outcome is Outcome.PUSHED)
            assert label in {target for _, target, _, _ in trial.rows} or trial.outcome is Outcome.PUSHED
            for (row, col), target, rewards, goes_on in trial.rows:
                assert env.state.labels[row, col] == target
                assert set(rewards) <= {0.0, PUSH_REWARD}
                assert not goes_on or trial.after is not None
    assert Outcome.PUSHED in seen


def test_what_is_done_aside_is_undone(env):
    before = env.state
    outcomes = []
    for _ in range(2):
        with env.aside():
            pushed = [env.advance(PUSH, k, middle(env, 1)) for k in range(0, 16, 2)]
            grasped = env.attempt(GRASP, 0, middle(env, int(env.state.labels.max())))
            assert env.state is not before
            outcomes.append([trial.outcome for trial in (*pushed, grasped)])
        assert env.state is before
    assert Outcome.PUSHED in outcomes[0]
    assert outcomes[0] == outcomes[1]
