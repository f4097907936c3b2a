"""Q maps of all rotations from a network that knows one."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from policy.network.encoding import GRASP, PUSH, encode
from policy.network.inference import Inference, fuse_norms
from policy.network.q_network import QNetwork
from policy.network.weights import save_weights

SIZE = 72
BOTH = pytest.mark.parametrize(("primitive", "rotations"), [(GRASP, 8), (PUSH, 16)])


@pytest.fixture(scope="module")
def network():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = QNetwork()
        # Norms that fit: a fresh network's maps are nearly flat.
        for _ in range(20):
            network(torch.randn(2, 5, 64, 64))
        return network


@pytest.fixture(scope="module")
def asked(network):
    return Inference(copy.deepcopy(network))


def scene():
    """Planes and objects: two blocks, 9 x 15 and 11 x 7 cells."""
    rng = np.random.default_rng(0)
    objects = np.zeros((SIZE, SIZE), np.bool_)
    objects[20:29, 24:39] = objects[34:45, 22:29] = True
    color = rng.integers(1, 256, (SIZE, SIZE, 3), np.uint8)
    return encode(np.where(objects, np.float32(0.05), np.float32(0)), color), objects


@BOTH
def test_maps_are_finite_where_they_were_asked_for(asked, primitive, rotations):
    planes, objects = scene()
    maps = asked.maps(planes, objects, primitive)
    assert maps.shape == (rotations, SIZE, SIZE)
    assert maps.dtype == np.float32
    assert np.isfinite(maps[:, objects]).all()
    assert np.isnan(maps[:, ~objects]).all()


@settings(max_examples=10)
@given(st.lists(st.tuples(st.integers(0, SIZE - 1), st.integers(0, SIZE - 1)), min_size=1, max_size=3))
def test_any_cells_may_be_asked_for(asked, spots):
    planes, _ = scene()
    cells = np.zeros((SIZE, SIZE), np.bool_)
    cells[tuple(np.transpose(spots))] = True
    maps = asked.maps(planes, cells, GRASP)
    assert np.array_equal(np.isfinite(maps), np.broadcast_to(cells, maps.shape))


@BOTH
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_quarter_turn_of_the_scene_turns_each_map_and_the_rotation_by_four(asked, primitive, rotations, quarters):
    def turn(stack):
        """From +x (columns) to +y (rows)."""
        return np.ascontiguousarray(np.rot90(stack, -quarters, axes=(-2, -1)))

    planes, objects = scene()
    maps = turn(asked.maps(planes, objects, primitive))
    turned = asked.maps(turn(planes), turn(objects), primitive)
    cells = turn(objects)
    spread = maps[:, cells].std()
    for k in range(rotations):
        after = (k + 4 * quarters) % 16
        # The network sees a grasp from one side only.
        if after < rotations:
            # At some cells, another neighbour is the nearest after the turn.
            assert np.quantile(np.abs(turned[after] - maps[k])[cells], 0.9) < 0.25 * spread
            # Not because all rotations are alike.
            assert np.quantile(np.abs(turned[after] - maps[k - 4])[cells], 0.9) > 0.5 * spread


class Ahead(nn.Module):
    """Grasps: the height of the cell. Pushes: the height 12 cells ahead."""

    def forward(self, x):
        return torch.stack([x[:, 0], x[:, 0].roll(-12, dims=-1)], dim=1)


@pytest.mark.parametrize("rotation", range(16))
def test_a_push_in_direction_k_is_valued_by_what_lies_in_direction_k(rotation):
    planes = np.zeros((5, SIZE, SIZE), np.float32)
    angle = np.pi * rotation / 8
    row, col = round(36 + 12 * np.sin(angle)), round(36 + 12 * np.cos(angle))
    planes[0, row - 1 : row + 2, col - 1 : col + 2] = 1
    cells = np.zeros((SIZE, SIZE), np.bool_)
    cells[36, 36] = True
    values = Inference(Ahead()).maps(planes, cells, PUSH)[:, 36, 36]
    assert values.tolist() == [float(k == rotation) for k in range(16)]


def test_large_copies_pass_one_after_the_other(network, asked):
    planes, objects = scene()
    whole = asked.maps(planes, objects, PUSH)
    one_by_one = Inference(network, cells_at_once=1)
    np.testing.assert_allclose(one_by_one.maps(planes, objects, PUSH), whole, atol=0.02)


def test_the_network_comes_from_a_file(network, asked, tmp_path):
    save_weights(tmp_path / "some.safetensors", network, "fast", {})
    planes, objects = scene()
    loaded = Inference.load(tmp_path / "some.safetensors")
    np.testing.assert_array_equal(loaded.maps(planes, objects, GRASP), asked.maps(planes, objects, GRASP))


def test_norms_that_are_fused_change_no_value():
    torch.manual_seed(3)
    network = QNetwork().train()
    x = torch.rand(2, 5, 32, 32)
    network(x)  # fills the norms' statistics
    network.eval()
    with torch.no_grad():
        before = network(x)
        fuse_norms(network)
        after = network(x)
    assert sum(isinstance(part, torch.nn.BatchNorm2d) for part in network.modules()) == 0
    assert torch.allclose(before, after, atol=1e-5)
