from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from torch import nn

from policy.network.encoding import GRASP, PUSH
from policy.network.q_network import QNetwork
from policy.training.collect import Collection
from policy.training.config import CollectSettings, LearningSettings
from policy.training.learner import Learner, auc
from policy.training.replay import Replay, View
from policy.training.shard import Shard
from tests.policy.training import toy

SIZE = 64
HEIGHT, RED, GREEN, BLUE = 0, 2, 3, 4
TRAINING, VALIDATION = 1, 16


@pytest.fixture(autouse=True)
def torch_draws() -> None:
    """The same random numbers of torch in every test."""
    torch.manual_seed(0)


# A bar's surroundings: those of the twin's objects are six times as many cells.
SMALL_CROP = 48


class Planes(nn.Module):
    """A network whose Q maps are planes of what it is shown, times a factor; keeps in which mode it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(1))
        self.planes = [RED, GREEN]
        self.modes: list[bool] = []

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.modes.append(self.training)
        return self.factor * x[:, self.planes]


class Values(nn.Module):
    """A network that gives every grasp one value, and every push another."""

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor([0.5, 0.0]))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.values[:, None, None].expand(len(x), 2, *x.shape[2:])


def make_view() -> View:
    """Two objects that `disagreeing` values; around them what would be best if it were an object."""
    height = np.full((SIZE, SIZE), 1001, np.uint16)
    color = np.full((SIZE, SIZE, 3), 255, np.uint8)
    labels = np.zeros((SIZE, SIZE), np.uint8)
    # The nearest cell of a copy may be a neighbour: colours reach 3 cells further than the objects.
    labels[10:20, 10:30], color[7:23, 7:20], color[7:23, 20:33] = 1, (200, 100, 50), (100, 180, 150)
    labels[40:50, 40:50], color[37:53, 37:53], height[37:53, 37:53] = 2, (160, 240, 20), 1501
    return View(height, color, labels)


def make_learner(network: nn.Module, **settings: float) -> Learner:
    return Learner(network, LearningSettings.model_validate(settings), stage=1, planned_updates=100, seed=0)


def disagreeing() -> Learner:
    """The online network values grasps by red and pushes by green, the target network by blue and by height."""
    learner = make_learner(Planes())
    learner.target.planes = [BLUE, HEIGHT]
    return learner


def make_shard(scenes: list[int], pushes: list[tuple[int, int]], view: View | None = None) -> Shard:
    """States that look alike; a push is (state, next state), at object 1, and has a grasp beside it."""
    view = view or make_view()
    rows = [(state, kind, after if kind == PUSH else -1) for state, after in pushes for kind in (PUSH, GRASP)]
    state, kind, after = np.array(rows).T
    count = len(rows)
    return Shard(
        **{name: np.stack([plane] * len(scenes)) for name, plane in view._asdict().items()},
        scene=np.array(scenes, np.int32),
        state=state.astype(np.int32),
        primitive=kind.astype(np.int8),
        row=np.full(count, 15, np.int16),
        col=np.full(count, 15, np.int16),
        rotation=np.zeros(count, np.int8),
        target=np.ones(count, np.int16),
        reward=np.where(kind == PUSH, 0.5, 1.0)[:, None].repeat(2, axis=1).astype(np.float32),
        next_state=after.astype(np.int32),
        greedy=np.zeros(count, np.bool_),
        outcome=np.zeros(count, np.int8),
    )


def make_replay(*shards: Shard) -> Replay:
    replay = Replay(stage=1, capacity_states=1000, alpha=0.6)
    replay.extend(shards)
    return replay


def of_color(value: int) -> float:
    return value / 127.5 - 1


@pytest.mark.parametrize(
    ("goal", "expected"),
    [
        # The reddest part; the target network finds 50 of blue there, though 150 beside it.
        (1, of_color(50)),
        # Greener than red, but what a push is worth does not count.
        (2, of_color(20)),
        # Gone.
        (3, 0.0),
    ],
)
def test_a_state_is_worth_the_double_q_value_of_a_grasp_at_the_goal(goal: int, expected: float) -> None:
    assert disagreeing().value(make_view(), goal) == pytest.approx(expected, abs=1e-6)


def test_a_lone_peak_is_not_the_best_grasp() -> None:
    view = make_view()
    view.color[45, 45], view.color[42:45, 40:44] = (255, 0, 255), (200, 0, 90)
    # The mean of its neighbours counts: the patch is redder than what is around the peak.
    assert disagreeing().value(view, 2) == pytest.approx(of_color(90), abs=1e-6)


def test_values_are_learned_with_what_follows() -> None:
    replay = make_replay(make_shard([TRAINING] * 2, [(0, 1), (0, -1)]))
    replay.value[0] = 0.8
    learner = make_learner(Values(), gamma=0.5, grasps=40, pushes=40)
    losses = learner.update(replay)
    # Pushes are held to be worth 0 but are worth 0.5 + 0.5 x 0.8 and 0.5, grasps 0.5 and 1.
    np.testing.assert_allclose(replay.priorities, (np.array([0.9, 0.5, 0.5, 0.5]) + 0.01) ** 0.6, rtol=1e-5)
    assert losses.grasp == pytest.approx(0.125)
    assert 0.125 < losses.push < 0.405


def test_looking_ahead_values_what_was_not_valued_and_then_the_oldest() -> None:
    learner = make_learner(Planes(), values_per_round=2)
    shard = make_shard([TRAINING, TRAINING, VALIDATION, VALIDATION], [(0, 1), (0, -1), (2, 3), (1, 0)])
    replay = make_replay(shard)
    steps: list[tuple[int, int]] = []
    learner.look_ahead(replay, 0, lambda done, total: steps.append((done, total)))
    assert steps == [(1, 2), (2, 2)]
    # Pushes that end their episode, grasps and held-out scenes are left alone.
    assert np.flatnonzero(replay.valued == 0).tolist() == [0, 6]
    assert replay.value[[0, 6]] == pytest.approx(of_color(200), abs=1e-6)
    assert not np.delete(replay.value, [0, 6]).any()
    replay.extend([shard, shard])
    learner.look_ahead(replay, 1)
    # All that are new, though they are more.
    assert np.flatnonzero(replay.valued == 1).tolist() == [8, 14, 16, 22]
    learner.look_ahead(replay, 2)
    assert np.flatnonzero(replay.valued == 2).tolist() == [0, 6]
    learner.look_ahead(replay, 3)
    assert np.flatnonzero(replay.valued == 3).tolist() == [8, 14]


def test_the_target_network_is_the_online_network_of_a_round_before() -> None:
    learner = make_learner(Planes(), values_per_round=2)
    replay = make_replay(make_shard([TRAINING] * 2, [(0, 1)]))
    found = []
    for round_, factor in enumerate((1.0, 2.0, 3.0, 4.0)):
        with torch.no_grad():
            learner.online.factor.fill_(factor)
        learner.look_ahead(replay, round_)
        found.append(float(replay.value[0]) / of_color(200))
    assert found == pytest.approx([1, 1, 2, 3])


def test_the_target_network_is_another_one_that_does_not_learn() -> None:
    learner = make_learner(QNetwork(), grasps=2, pushes=2)
    online, target = dict(learner.online.named_parameters()), dict(learner.target.named_parameters())
    assert not {tensor.data_ptr() for tensor in online.values()} & {tensor.data_ptr() for tensor in target.values()}
    assert not any(tensor.requires_grad for tensor in target.values())
    replay = make_replay(make_shard([TRAINING] * 2, [(0, 1)]))
    before = copy.deepcopy(learner.target.state_dict())
    learner.update(replay)
    assert all(torch.equal(tensor, before[name]) for name, tensor in learner.target.state_dict().items())
    assert not all(torch.equal(online[name], target[name]) for name in online)
    learner.look_ahead(replay, 1)
    assert all(torch.equal(online[name], target[name]) for name in online)


def test_looking_ahead_leaves_the_norm_statistics_alone() -> None:
    learner = make_learner(QNetwork(), grasps=2, pushes=2)
    replay = make_replay(make_shard([TRAINING, VALIDATION], [(0, 0), (1, -1)]))
    learner.update(replay)
    before = {name: buffer.clone() for name, buffer in learner.online.named_buffers()}
    learner.look_ahead(replay, 0)
    learner.validate(replay, 10)
    assert all(torch.equal(buffer, before[name]) for name, buffer in learner.online.named_buffers())
    learner.update(replay)
    assert not all(torch.equal(buffer, before[name]) for name, buffer in learner.online.named_buffers())


def test_modes_of_the_networks() -> None:
    learner = make_learner(Planes(), grasps=2, pushes=2)
    replay = make_replay(make_shard([TRAINING, VALIDATION], [(0, 0), (1, -1)]))
    learner.update(replay)
    learner.look_ahead(replay, 0)
    learner.validate(replay, 10)
    assert learner.online.modes == [True, False, False]
    assert learner.target.modes == [False]


def test_losses_are_hubers_weighted_by_importance() -> None:
    learner = make_learner(Values(), push_weight=2.0)
    crops = np.zeros((4, 5, 16, 16), np.float32)
    # Errors: grasps 0.5 and 0.5, then 2.5 (beyond the quadratic part); push 0.5.
    kinds, wanted = np.array([GRASP, GRASP, GRASP, PUSH]), np.array([1.0, 0.0, 3.0, 0.5], np.float32)
    losses, errors = learner.learn(crops, kinds, wanted, np.array([1, 1, 0.5, 0.5], np.float32))
    assert losses.grasp == pytest.approx((0.125 + 0.125 + 0.5 * 2.0) / 3)
    assert losses.push == pytest.approx(0.5 * 0.125)
    assert losses.error == pytest.approx((0.5 + 0.5 + 2.5 + 0.5) / 4)
    assert errors.tolist() == pytest.approx([0.5, 0.5, 2.5, 0.5])
    # Of the last layer: (0.5 - 0.5 - 0.5) / 3 and twice -0.25; the length of both stays below the limit.
    assert learner.online.values.grad.tolist() == pytest.approx([-0.5 / 3, -0.5])


def test_gradients_are_clipped() -> None:
    learner = make_learner(Values(), gradient_norm=0.01)
    one = np.ones(2, np.float32)
    learner.learn(np.zeros((2, 5, 16, 16), np.float32), np.array([GRASP, PUSH]), 9 * one, one)
    assert float(learner.online.values.grad.norm()) == pytest.approx(0.01, rel=1e-3)


def test_a_batch_may_lack_a_primitive() -> None:
    learner = make_learner(QNetwork())
    crops, one = np.zeros((2, 5, 16, 16), np.float32), np.ones(2, np.float32)
    losses, errors = learner.learn(crops, np.array([GRASP, GRASP]), one, one)
    assert math.isnan(losses.push)
    assert losses.grasp > 0
    assert np.isfinite(errors).all()
    assert all(torch.isfinite(tensor).all() for tensor in learner.online.parameters())


def test_the_learning_rate_follows_half_a_cosine() -> None:
    learner = make_learner(Values(), learning_rate=1e-3, final_learning_rate=1e-4)
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


def test_without_held_out_attempts_nothing_is_measured() -> None:
    measured = make_learner(Values()).validate(make_replay(make_shard([TRAINING], [(0, -1)])), 10)
    assert measured.keys() == {"grasp_auc", "push_auc"}
    assert all(math.isnan(value) for value in measured.values())


def toy_replay() -> Replay:
    settings = CollectSettings(grasps=24, pushes=12)
    scenes = (tuple(range(first, first + 8)) for first in range(1000, 1256, 8))
    return make_replay(*(toy.collect(Collection(1, seeds, None, 1.0, settings)) for seeds in scenes))


def test_it_learns_what_the_picture_tells() -> None:
    """Across and along a bar, in scenes that it was never trained on."""
    replay, updates = toy_replay(), 64
    settings = LearningSettings(learning_rate=3e-3)
    learner = Learner(QNetwork(), settings, stage=1, planned_updates=updates, seed=0, crop_cells=SMALL_CROP)
    assert 0.3 < learner.validate(replay, 400)["grasp_auc"] < 0.7
    for _ in range(updates):
        learner.update(replay)
    measured = learner.validate(replay, 400)
    assert measured["grasp_auc"] > 0.9
    assert measured["push_auc"] > 0.9


def test_updates_can_be_repeated_from_a_saved_state() -> None:
    settings = LearningSettings(grasps=4, pushes=4)
    first, again = (
        Learner(QNetwork(), settings, stage=1, planned_updates=6, seed=0, crop_cells=SMALL_CROP) for _ in range(2)
    )
    shard = make_shard([TRAINING] * 4, [(0, 1), (1, 2), (2, -1), (3, -1)])
    replay, same = make_replay(shard), make_replay(shard)
    first.look_ahead(replay, 0)
    for _ in range(3):
        first.update(replay)
    # As through a file: nothing is shared.
    again.load_state(copy.deepcopy(first.state()))
    same.priorities, same.value, same.valued = replay.priorities, replay.value.copy(), replay.valued.copy()
    for learner, attempts in ((first, replay), (again, same)):
        learner.look_ahead(attempts, 1)
    np.testing.assert_array_equal(replay.value, same.value)
    losses = [(first.update(replay), again.update(same)) for _ in range(3)]
    assert all(one == other for one, other in losses)
    assert len({one.grasp for one, _ in losses}) == 3
