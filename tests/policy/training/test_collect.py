"""What a rollout worker brings home."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import policy
from policy.network.encoding import GRASP, PUSH
from policy.training.collect import Collection, collect
from policy.training.config import CollectSettings
from policy.training.shard import Shard, pack_height, unpack_height

SEEDS = (1_500_001, 1_500_002)
SHIPPED = Path(policy.__file__).parent / "data" / "learned.safetensors"


@pytest.fixture(scope="module")
def shard():
    return play(SEEDS)


def play(seeds, stage=1):
    return collect(Collection(stage, seeds, None, 1.0, CollectSettings(grasps=3, pushes=1, states=2)))


def test_every_attempt_is_at_a_cell_of_its_target(shard):
    assert len(shard.state)
    labels = shard.labels[shard.state, shard.row, shard.col]
    assert np.array_equal(labels, shard.target)
    assert (shard.target > 0).all()


def test_rotations_belong_to_their_primitive(shard):
    grasps, pushes = shard.primitive == GRASP, shard.primitive == PUSH
    assert (grasps | pushes).all()
    assert grasps.any()
    assert pushes.any()
    assert (shard.rotation[grasps] < 8).all()
    assert (shard.rotation >= 0).all()
    assert (shard.rotation < 16).all()


def test_only_pushes_lead_on_and_only_within_their_scene(shard):
    on = shard.next_state >= 0
    assert not on[shard.primitive == GRASP].any()
    assert (shard.scene[shard.next_state[on]] == shard.scene[shard.state[on]]).all()
    assert set(shard.scene.tolist()) == set(SEEDS)


def test_a_scene_gives_the_same_wherever_it_is_played(shard):
    alone = play(SEEDS[:1])
    assert 0 < len(alone.state) < len(shard.state)
    for field in fields(Shard):
        again = getattr(alone, field.name)
        assert np.array_equal(again, getattr(shard, field.name)[: len(again)]), field.name


def test_a_shard_comes_back_from_its_file(shard, tmp_path):
    path = tmp_path / "r0000-t000.npz"
    shard.save(path)
    loaded = Shard.load(path)
    assert all(np.array_equal(getattr(loaded, f.name), getattr(shard, f.name)) for f in fields(Shard))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_heights_are_kept_to_a_tenth_of_a_millimetre():
    heights = np.array([[-0.1, 0.0, 0.1234], [0.3, np.nan, 0.05]], np.float32)
    back = unpack_height(pack_height(heights))
    assert np.array_equal(np.isnan(back), np.isnan(heights))
    assert back == pytest.approx(heights, abs=0.6e-4, nan_ok=True)


def test_what_was_pushed_is_grasped_at_where_it_then_lies():
    settings = CollectSettings(grasps=0, pushes=4, states=1)
    played = collect(Collection(2, SEEDS, SHIPPED, 0.5, settings))
    grasps = np.flatnonzero(played.primitive == GRASP)
    assert len(grasps)
    for i in grasps:
        led_here = played.next_state == played.state[i]
        assert played.target[i] in played.target[led_here]
        assert played.greedy[i]
