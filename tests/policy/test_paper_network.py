import numpy as np
import pytest
import torch
from scipy import ndimage

from policy.network import QNetwork
from policy.networks import make_network
from policy.paper_network import PaperNetwork


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    # On maps this small, a second thread costs more than it gives.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def network():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return make_network("paper").eval()


def maps(network, planes):
    with torch.no_grad():
        return network(planes)


def planes(rows, cols, seed):
    return torch.randn(1, 5, rows, cols, generator=torch.Generator().manual_seed(seed))


def quarter_turn(x):
    """From +x (columns) to +y (rows)."""
    return torch.rot90(x, 1, (3, 2)).contiguous()


def test_it_has_the_parameters_of_the_paper(network):
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(18.4e6, rel=0.01)


def test_its_trunks_are_densenet_121(network):
    # DenseNet-121 has 7,978,856 parameters, of which its classifier has 1000 x 1024 + 1000.
    for trunk in (network.color, network.height):
        assert sum(p.numel() for p in trunk.parameters()) == 7_978_856 - 1_025_000


def test_it_gives_the_maps_that_the_fast_network_gives(network):
    x = planes(16, 16, seed=1)
    for one, other in zip(maps(network, x), maps(QNetwork().eval(), x), strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype == torch.float32


def test_a_quarter_turn_of_the_table_turns_each_map_and_the_rotation_by_four(network):
    x = planes(16, 21, seed=2)
    for q, turned in zip(maps(network, x), maps(network, quarter_turn(x)), strict=True):
        torch.testing.assert_close(quarter_turn(q).roll(4, dims=1), turned, atol=1e-6, rtol=1e-4)
        # Not because all maps are alike.
        assert (q - q.roll(1, dims=1)).abs().max() > 1e-3


def test_one_step_of_the_table_turns_each_map_and_the_rotation_by_one(network):
    blobs = ndimage.gaussian_filter(np.random.default_rng(2).normal(size=(5, 32, 32)), (0, 3, 3), truncate=2)
    rows, cols = np.indices((32, 32)) - 15.5
    blobs *= 20 * np.exp(-(rows**2 + cols**2) / 2 / 5**2)
    angle = np.pi / 8

    def step(stack):
        """Each map turned by 22.5 degrees from +x (columns) to +y (rows)."""
        matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        offset = 15.5 - matrix @ (15.5, 15.5)
        return np.stack([ndimage.affine_transform(m, matrix, offset, order=1) for m in stack])

    def look(stack):
        return [q[0].numpy() for q in maps(network, torch.from_numpy(stack.astype(np.float32))[None])]

    middle = rows**2 + cols**2 < 12**2
    for q, turned in zip(look(blobs), look(step(blobs)), strict=True):
        expected = np.roll(step(q), 1, axis=0)
        unlike = np.roll(step(q), -1, axis=0)
        error = np.abs(expected - turned)[:, middle].mean()
        assert error < 0.15 * np.abs(unlike - turned)[:, middle].mean()


def test_it_does_not_see_the_plane_of_holes(network):
    x = planes(16, 16, seed=3).repeat(2, 1, 1, 1)
    x[1, 1] = 1 - x[1, 1]
    for q in maps(network, x):
        assert torch.equal(q[0], q[1])


def test_gradients_reach_every_parameter():
    network = PaperNetwork().train()
    grasp, push = network(torch.cat([planes(11, 11, seed=6), planes(11, 11, seed=7)]))
    (grasp[:, 2, 3, 4].sum() + push[:, 13, 4, 3].sum()).backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert silent == []
    for module in (network.color, network.height, network.grasp, network.push):
        assert all(p.grad.any() for p in module.parameters())
