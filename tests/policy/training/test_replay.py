from __future__ import annotations

import numpy as np
import pytest

from policy.network.encoding import GRASP, PUSH
from policy.training.config import held_out
from policy.training.replay import Replay
from policy.training.shard import Shard

TRAINING, VALIDATION = 1, 16
# Of an attempt without error.
LEAST = 0.01


def make_shard(scenes: list[int], attempts: list[tuple[int, int, int]]) -> Shard:
    """Attempts are (state, primitive, next state), the col of each its number; a state's height is its number + 1."""
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


def make_replay(*shards: Shard, stage: int = 1, capacity: int = 100, alpha: float = 1.0) -> Replay:
    replay = Replay(stage, capacity, alpha)
    replay.extend(shards)
    return replay


def seen(replay: Replay, numbers: np.typing.NDArray[np.int64]) -> list[int]:
    """The states of attempts, as the views tell them."""
    attempts = replay.attempts.take(numbers)
    views = [replay.view(int(shard), int(state)) for shard, state in zip(attempts.shard, attempts.state, strict=True)]
    return [int(view.height[0, 0]) - 1 for view in views]


def test_held_out_scenes_are_never_drawn() -> None:
    replay = make_replay(
        make_shard([TRAINING, VALIDATION, TRAINING, TRAINING], [(0, GRASP, -1), (1, GRASP, -1), (2, GRASP, -1)])
    )
    assert held_out(VALIDATION)
    assert not held_out(TRAINING)
    assert len(replay) == 3
    numbers, _ = replay.draw(GRASP, 200, 0.4, np.random.default_rng(0))
    assert set(seen(replay, numbers)) == {0, 2}
    assert seen(replay, replay.validation(10)) == [1]


def test_only_the_newest_are_for_validation() -> None:
    replay = make_replay(make_shard([VALIDATION] * 3, [(state, GRASP, -1) for state in range(3)]))
    assert seen(replay, replay.validation(2)) == [1, 2]


def test_attempts_are_drawn_in_proportion_to_their_priorities() -> None:
    # Among pushes, which nobody asks for.
    attempts = [(state, kind, -1) for state in range(4) for kind in (PUSH, GRASP)]
    replay = make_replay(make_shard([TRAINING] * 4, attempts), alpha=0.5)
    grasps = np.flatnonzero(replay.attempts.primitive == GRASP)
    replay.update(grasps, np.array([0.01, 0.04, 0.09, 0.16], np.float32) - np.float32(LEAST))
    count = 40_000
    numbers, weights = replay.draw(GRASP, count, 0.7, np.random.default_rng(0))
    assert set(numbers) == set(grasps)
    frequency = np.bincount(numbers, minlength=8)[grasps] / count
    # Square roots of the errors: 1, 2, 3, 4 of 10.
    expected = np.array([0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(frequency, expected, atol=0.01)
    importance = (4 * expected) ** -0.7
    np.testing.assert_allclose(weights, (importance / importance.max())[numbers // 2], rtol=1e-4)


def test_new_attempts_have_the_largest_priority() -> None:
    shard = make_shard([TRAINING] * 2, [(0, GRASP, -1), (1, GRASP, -1)])
    replay = make_replay(shard)
    replay.update(np.array([0, 1]), np.array([0.1, 5.0], np.float32))
    replay.extend([shard])
    np.testing.assert_allclose(replay.priorities, np.array([0.1, 5, 5, 5]) + LEAST, rtol=1e-5)
    # Nothing is known yet of what follows them.
    assert replay.valued.tolist() == [-1] * 4
    assert replay.value.tolist() == [0] * 4


def test_the_oldest_shards_give_way_with_all_that_is_known_of_them() -> None:
    shard = make_shard([TRAINING] * 2, [(0, PUSH, 1), (1, GRASP, -1)])
    replay = make_replay(shard, shard, capacity=4)
    replay.update(np.arange(4), np.array([1, 2, 3, 4], np.float32))
    replay.value[:] = [0.1, 0.2, 0.3, 0.4]
    replay.valued[:] = [1, 2, 3, 4]
    replay.extend([shard])
    np.testing.assert_allclose(replay.priorities, np.array([3, 4, 4, 4]) + LEAST, rtol=1e-5)
    assert replay.value.tolist() == pytest.approx([0.3, 0.4, 0, 0])
    assert replay.valued.tolist() == [3, 4, -1, -1]
    assert replay.attempts.shard.tolist() == [1, 1, 2, 2]
    assert seen(replay, np.arange(4)) == [0, 1, 0, 1]


def test_one_shard_is_always_kept() -> None:
    shard = make_shard([TRAINING] * 9, [(8, GRASP, -1)])
    assert len(make_replay(shard, shard, capacity=4)) == 1


def test_priorities_can_be_put_back() -> None:
    replay = make_replay(make_shard([TRAINING] * 2, [(0, GRASP, -1), (1, GRASP, -1)]))
    replay.priorities = np.array([1.0, 3.0])
    numbers, _ = replay.draw(GRASP, 10_000, 1.0, np.random.default_rng(0))
    assert numbers.mean() == pytest.approx(0.75, abs=0.02)
    with pytest.raises(ValueError, match="1 priorities for 2 attempts"):
        replay.priorities = np.array([1.0])


@pytest.mark.parametrize(("stage", "reward"), [(1, 0.25), (2, 1.0)])
def test_rewards_are_those_of_the_stage(stage: int, reward: float) -> None:
    replay = make_replay(make_shard([TRAINING], [(0, GRASP, -1)]), stage=stage)
    assert replay.attempts.reward.tolist() == [reward]


def test_attempts_are_those_of_the_shards_in_their_order() -> None:
    attempts = [(1, PUSH, 2), (0, GRASP, -1), (1, PUSH, -1)]
    replay = make_replay(make_shard([TRAINING] * 3, attempts), make_shard([TRAINING] * 2, attempts[1:]))
    assert replay.attempts.col.tolist() == [0, 1, 2, 0, 1]
    assert replay.attempts.next_state.tolist() == [2, -1, -1, -1, -1]
    assert replay.attempts.primitive.tolist() == [PUSH, GRASP, PUSH, GRASP, PUSH]
    assert replay.attempts.shard.tolist() == [0, 0, 0, 1, 1]
    assert seen(replay, np.array([0, 1, 4])) == [1, 0, 1]


def test_nothing_is_nothing() -> None:
    replay = make_replay(make_shard([TRAINING], []))
    assert len(replay) == 0
    assert len(replay.validation(5)) == 0
    numbers, weights = replay.draw(PUSH, 3, 0.4, np.random.default_rng(0))
    assert len(numbers) == len(weights) == 0
