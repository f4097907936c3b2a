from __future__ import annotations

import numpy as np
import pytest

from policy.training.config import held_out
from policy.training.replay import Replay
from policy.training.shard import GRASP, PUSH, Shard

TRAINING, VALIDATION = 1, 16


def make_shard(scenes: list[int], attempts: list[tuple[int, int, int]]) -> Shard:
    """Attempts are (state, primitive, next state); the height of a state is its number + 1."""
    count = len(attempts)
    columns = np.array(attempts, np.int32).reshape(-1, 3).T
    heights = np.arange(1, len(scenes) + 1, dtype=np.uint16)[:, None, None]
    return Shard(
        height=np.broadcast_to(heights, (len(scenes), 4, 4)).copy(),
        color=np.zeros((len(scenes), 4, 4, 3), np.uint8),
        labels=np.zeros((len(scenes), 4, 4), np.uint8),
        scene=np.array(scenes, np.int32),
        state=columns[0],
        primitive=columns[1].astype(np.int8),
        row=np.zeros(count, np.int16),
        col=np.arange(count, dtype=np.int16),
        rotation=np.zeros(count, np.int8),
        target=np.ones(count, np.int16),
        reward=np.tile([[0.25, 1.0]], (count, 1)).astype(np.float32),
        next_state=columns[2],
        greedy=np.zeros(count, np.bool_),
        outcome=np.zeros(count, np.int8),
    )


def test_held_out_scenes_are_never_drawn() -> None:
    replay = Replay(stage=1, capacity_states=100, alpha=0.6)
    shard = make_shard([TRAINING, VALIDATION, TRAINING, TRAINING], [(0, GRASP, -1), (1, GRASP, -1), (2, GRASP, -1)])
    replay.extend([shard])
    assert held_out(VALIDATION)
    assert not held_out(TRAINING)
    # The last state has no attempts.
    assert len(replay) == 2
    rng = np.random.default_rng(0)
    indices, _ = replay.draw(200, 0.4, rng)
    drawn = {int(replay.sample(int(i), 1, rng).view.height[0, 0]) for i in indices}
    assert drawn == {1, 3}
    assert [int(sample.view.height[0, 0]) for sample in replay.validation(10)] == [2]


def test_states_are_drawn_in_proportion_to_their_priorities() -> None:
    replay = Replay(stage=1, capacity_states=100, alpha=0.5)
    replay.extend([make_shard([TRAINING] * 4, [(i, GRASP, -1) for i in range(4)])])
    replay.update(np.arange(4), np.array([0.01, 0.04, 0.09, 0.16], np.float32) - np.float32(1e-3))
    count = 40_000
    indices, weights = replay.draw(count, 0.7, np.random.default_rng(0))
    frequency = np.bincount(indices, minlength=4) / count
    # Square roots of the errors: 1, 2, 3, 4 of 10.
    expected = np.array([0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(frequency, expected, atol=0.01)
    importance = (4 * expected) ** -0.7
    np.testing.assert_allclose(weights, (importance / importance.max())[indices], rtol=1e-4)


def test_new_states_have_the_largest_priority() -> None:
    replay = Replay(stage=1, capacity_states=100, alpha=1.0)
    shard = make_shard([TRAINING] * 2, [(0, GRASP, -1), (1, GRASP, -1)])
    replay.extend([shard])
    replay.update(np.array([0, 1]), np.array([0.1, 5.0], np.float32))
    replay.extend([shard])
    np.testing.assert_allclose(replay.priorities, [0.101, 5.001, 5.001, 5.001], rtol=1e-5)


def test_the_oldest_shards_give_way_with_their_priorities() -> None:
    replay = Replay(stage=1, capacity_states=4, alpha=1.0)
    shard = make_shard([TRAINING] * 2, [(0, GRASP, -1), (1, GRASP, -1)])
    replay.extend([shard, shard])
    replay.update(np.arange(4), np.array([1, 2, 3, 4], np.float32))
    replay.extend([shard])
    np.testing.assert_allclose(replay.priorities, [3.001, 4.001, 4.001, 4.001], rtol=1e-5)
    replay.priorities = np.array([1.0, 2.0, 3.0, 4.0])
    with pytest.raises(ValueError, match="2 priorities for 4 states"):
        replay.priorities = np.array([1.0, 2.0])


@pytest.mark.parametrize(("stage", "reward"), [(1, 0.25), (2, 1.0)])
def test_a_sample_has_the_rewards_of_its_stage(stage: int, reward: float) -> None:
    replay = Replay(stage, capacity_states=10, alpha=0.6)
    replay.extend([make_shard([TRAINING], [(0, GRASP, -1)])])
    assert replay.sample(0, 1, np.random.default_rng(0)).reward.tolist() == [reward]


def test_pushes_into_the_same_state_stay_together() -> None:
    # Three rows of one push into state 1, one push into state 2, one that ended, one grasp; in mixed order.
    attempts = [(0, PUSH, 1), (0, PUSH, 2), (0, GRASP, -1), (0, PUSH, 1), (0, PUSH, -1), (0, PUSH, 1)]
    replay = Replay(stage=1, capacity_states=10, alpha=0.6)
    replay.extend([make_shard([TRAINING] * 3, attempts)])
    rng = np.random.default_rng(0)
    kept = set()
    for _ in range(50):
        sample = replay.sample(0, 1, rng)
        after = int(sample.views_after[0].height[0, 0]) - 1
        kept.add(after)
        assert sample.col.tolist() == ([0, 2, 3, 4, 5] if after == 1 else [1, 2, 4])
        assert sample.following.tolist() == ([0, -1, 0, -1, 0] if after == 1 else [0, -1, -1])
    assert kept == {1, 2}
    both = replay.sample(0, 2, rng)
    assert [int(both.views_after[i].height[0, 0]) - 1 for i in both.following[both.following >= 0]] == [1, 2, 1, 1]


def test_attempts_are_found_by_their_state() -> None:
    attempts = [(1, GRASP, -1), (0, GRASP, -1), (1, PUSH, -1)]
    replay = Replay(stage=1, capacity_states=10, alpha=0.6)
    replay.extend([make_shard([TRAINING] * 2, attempts)])
    samples = [replay.sample(i, 1, np.random.default_rng(0)) for i in range(2)]
    assert [sample.col.tolist() for sample in samples] == [[1], [0, 2]]


def test_nothing_is_nothing() -> None:
    replay = Replay(stage=1, capacity_states=10, alpha=0.6)
    replay.extend([make_shard([TRAINING], [])])
    assert len(replay) == 0
    assert replay.validation(5) == []
