from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from torch import nn

from policy.network import QNetwork
from policy.training.collect import Collection
from policy.training.config import CollectSettings, LearningSettings
from policy.training.learner import Learner, auc
from policy.training.replay import Replay, Sample, View
from policy.training.shard import GRASP, PUSH
from tests.policy.training import toy

if TYPE_CHECKING:
    from collections.abc import Iterator

SIZE = 32
GAMMA = 0.5


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Sums in a fixed order, and torch's own random numbers."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(before)


class Maps(nn.Module):
    """A network whose maps are the same for every input; counts in which mode it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.grasp = nn.Parameter(torch.zeros(8, SIZE, SIZE))
        self.push = nn.Parameter(torch.zeros(16, SIZE, SIZE))
        self.modes: list[bool] = []

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.modes.append(self.training)
        return tuple(maps.expand(len(x), -1, -1, -1) for maps in (self.grasp, self.push))  # type: ignore[return-value]


def make_view(*spots: tuple[int, int]) -> View:
    """Objects of 3 x 3 cells around (row, col), labelled from 1."""
    labels = np.zeros((SIZE, SIZE), np.uint8)
    for label, (row, col) in enumerate(spots, 1):
        labels[row - 1 : row + 2, col - 1 : col + 2] = label
    height = np.where(labels > 0, 1500, 1000).astype(np.uint16)
    return View(height, np.zeros((SIZE, SIZE, 3), np.uint8), labels)


def make_sample(view: View, attempts: list[tuple[int, int, float, int]], after: tuple[View, ...] = ()) -> Sample:
    """Attempts are (primitive, target, reward, following), all at cell (5, 6) and plane 2."""
    primitive, target, reward, following = zip(*attempts, strict=True)
    count = len(attempts)
    return Sample(
        view=view,
        primitive=np.array(primitive, np.int8),
        row=np.full(count, 5, np.int16),
        col=np.full(count, 6, np.int16),
        rotation=np.full(count, 2, np.int8),
        target=np.array(target, np.int16),
        reward=np.array(reward, np.float32),
        following=np.array(following),
        views_after=after,
    )


def make_learner(network: nn.Module, stage: int, **settings: float) -> Learner:
    values = LearningSettings.model_validate({"gamma": GAMMA, **settings})
    return Learner(network, values, stage, planned_updates=100, seed=0)


def double_q_learner(stage: int) -> Learner:
    """Two objects 1 and 2 at (5, 6) and (25, 26). Online and target network disagree about what they are worth."""
    learner = make_learner(Maps(), stage)
    with torch.no_grad():
        # Beside the objects: never an action.
        learner.online.grasp[0, 15, 15] = 9
        learner.target.grasp[0, 15, 15] = 9
        learner.online.push[0, 10, 6] = 9
        # Object 1: the online network prefers plane 3, whose value the target network puts at 0.25.
        learner.online.grasp[3, 5, 6] = 0.5
        learner.target.grasp[3, 5, 6] = 0.25
        learner.target.grasp[4, 5, 6] = 1
        # Object 2: a push is preferred.
        learner.online.grasp[1, 25, 26] = 0.5
        learner.target.grasp[1, 25, 26] = 1
        learner.online.push[9, 26, 27] = 0.75
        learner.target.push[9, 26, 27] = 0.5
    return learner


@pytest.mark.parametrize(
    ("stage", "target", "expected"),
    [
        (2, 1, 0.5 + GAMMA * 0.25),
        (2, 2, 0.5 + GAMMA * 0.5),
        # Pick-all: the best action at any object follows.
        (1, 1, 0.5 + GAMMA * 0.5),
        # The target is gone: nothing follows.
        (2, 3, 0.5),
    ],
)
def test_the_target_value_is_that_of_double_q_learning(stage: int, target: int, expected: float) -> None:
    view = make_view((5, 6), (25, 26))
    sample = make_sample(view, [(GRASP, target, 1.0, -1), (PUSH, target, 0.5, 0), (PUSH, target, 0.5, -1)], (view,))
    values = double_q_learner(stage).targets([sample]).tolist()
    assert values == pytest.approx([1.0, expected, 0.5])


def test_each_attempt_is_worth_what_follows_for_its_own_target() -> None:
    """Several rows of one push, several samples, and states after them in a row."""
    near, far = make_view((5, 6)), make_view((15, 3), (25, 26))
    first = make_sample(near, [(PUSH, 1, 0, 1), (PUSH, 2, 0, 1), (PUSH, 1, 0, 0)], (near, far))
    second = make_sample(near, [(GRASP, 1, 1, -1), (PUSH, 1, 0.5, 0)], (near,))
    values = double_q_learner(2).targets([first, make_sample(near, [(GRASP, 1, 0, -1)]), second]).tolist()
    assert values == pytest.approx([0, GAMMA * 0.5, GAMMA * 0.25, 0, 1, 0.5 + GAMMA * 0.25])


def test_no_objects_left_is_the_end() -> None:
    sample = make_sample(make_view((5, 6)), [(PUSH, 1, 0.5, 0)], (make_view(),))
    assert double_q_learner(1).targets([sample]).tolist() == [0.5]


def test_the_target_network_is_another_one_and_follows_at_intervals() -> None:
    learner = make_learner(QNetwork(), 1, target_sync=3)
    online, target = dict(learner.online.named_parameters()), dict(learner.target.named_parameters())
    assert not {tensor.data_ptr() for tensor in online.values()} & {tensor.data_ptr() for tensor in target.values()}
    assert not any(tensor.requires_grad for tensor in target.values())
    sample = make_sample(make_view((5, 6)), [(GRASP, 1, 1.0, -1), (PUSH, 1, 0.5, -1)])
    same = []
    for _ in range(4):
        learner.learn([sample], np.ones(1, np.float32))
        same.append(all(torch.equal(online[name], target[name]) for name in online))
    assert same == [False, False, True, False]


def test_looking_ahead_leaves_the_norm_statistics_alone() -> None:
    learner = make_learner(QNetwork(), 1)
    view = make_view((5, 6))
    before = {name: buffer.clone() for name, buffer in learner.online.named_buffers()}
    sample = make_sample(view, [(PUSH, 1, 0.5, 0)], (view,))
    learner.targets([sample])
    learner.validate([sample])
    assert all(torch.equal(buffer, before[name]) for name, buffer in learner.online.named_buffers())
    learner.learn([sample], np.ones(1, np.float32))
    assert not all(torch.equal(buffer, before[name]) for name, buffer in learner.online.named_buffers())


def test_modes_of_the_online_network() -> None:
    learner = make_learner(Maps(), 1)
    view = make_view((5, 6))
    learner.learn([make_sample(view, [(PUSH, 1, 0.5, 0)], (view,))], np.ones(1, np.float32))
    assert learner.online.modes == [False, True]
    assert learner.target.modes == [False]


def test_losses_are_hubers_weighted_by_importance() -> None:
    learner = make_learner(Maps(), 1, push_weight=2.0)
    with torch.no_grad():
        learner.online.grasp[2, 5, 6] = 0.5
    view = make_view((5, 6))
    # Errors: grasps 0.5 and 0.5, then 2.5 (beyond the quadratic part); push 0.5.
    samples = [
        make_sample(view, [(GRASP, 1, 1.0, -1), (GRASP, 1, 0.0, -1)]),
        make_sample(view, [(GRASP, 1, 3.0, -1), (PUSH, 1, 0.5, -1)]),
    ]
    losses, errors = learner.learn(samples, np.array([1.0, 0.5], np.float32))
    assert losses.grasp == pytest.approx((0.125 + 0.125 + 0.5 * 2.0) / 3)
    assert losses.push == pytest.approx(0.5 * 0.125)
    assert losses.error == pytest.approx((0.5 + 0.5 + 2.5 + 0.5) / 4)
    assert errors.tolist() == pytest.approx([0.5, 1.5])


def test_a_batch_may_lack_a_primitive_or_any_attempt() -> None:
    learner = make_learner(QNetwork(), 1)
    grasps = make_sample(make_view((5, 6)), [(GRASP, 1, 1.0, -1)])
    none = replace(
        grasps,
        **{
            name: getattr(grasps, name)[:0]
            for name in ("primitive", "row", "col", "rotation", "target", "reward", "following")
        },
    )
    losses, errors = learner.learn([grasps, none], np.ones(2, np.float32))
    assert math.isnan(losses.push)
    assert losses.grasp > 0
    assert not math.isnan(errors[0])
    assert math.isnan(errors[1])
    learner.learn([none], np.ones(1, np.float32))
    assert all(torch.isfinite(tensor).all() for tensor in learner.online.parameters())


def test_the_learning_rate_follows_half_a_cosine() -> None:
    learner = make_learner(Maps(), 1, learning_rate=1e-3, final_learning_rate=1e-4)
    rates = []
    for learner.updates in (0, 50, 100, 120):
        rates.append(learner.learning_rate)
    assert rates == pytest.approx([1e-3, 5.5e-4, 1e-4, 1e-4])


def test_auc_is_the_chance_that_a_positive_is_above_a_negative() -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(0, 8, 60).astype(np.float32)
    positive = rng.random(60) < 0.4
    pairs = [(p > n) + (p == n) / 2 for p in values[positive] for n in values[~positive]]
    assert auc(values, positive) == pytest.approx(np.mean(pairs))
    assert math.isnan(auc(values, np.ones(60, np.bool_)))


def make_replay() -> Replay:
    settings = CollectSettings(grasps=24, pushes=12)
    replay = Replay(stage=1, capacity_states=10_000, alpha=0.6)
    scenes = (tuple(range(first, first + 8)) for first in range(1000, 1256, 8))
    replay.extend(toy.collect(Collection(1, seeds, None, 1.0, settings)) for seeds in scenes)
    return replay


def test_it_learns_what_the_picture_tells() -> None:
    """Across and along a bar, in scenes that it was never trained on."""
    replay, updates = make_replay(), 240
    settings = LearningSettings(learning_rate=3e-3, target_sync=50)
    learner = Learner(QNetwork(), settings, stage=1, planned_updates=updates, seed=0)
    held_out = replay.validation(1000)
    assert 0.3 < learner.validate(held_out)["grasp_auc"] < 0.7
    for _ in range(updates):
        learner.update(replay)
    measured = learner.validate(held_out)
    assert measured["grasp_auc"] > 0.9
    assert measured["push_auc"] > 0.7


def test_updates_can_be_repeated_from_a_saved_state() -> None:
    settings = LearningSettings(target_sync=2)
    first, again = (Learner(QNetwork(), settings, stage=1, planned_updates=6, seed=0) for _ in range(2))
    replay, same = make_replay(), make_replay()
    for _ in range(3):
        first.update(replay)
    # As through a file: nothing is shared.
    again.load_state(copy.deepcopy(first.state()))
    same.priorities = replay.priorities
    losses = [(first.update(replay), again.update(same)) for _ in range(3)]
    assert all(one == other for one, other in losses)
    assert len({one.grasp for one, _ in losses}) == 3
