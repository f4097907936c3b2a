import pytest
import torch

from policy.network.paper import PaperNetwork
from policy.network.q_network import QNetwork
from policy.network.registry import make_network


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


def test_it_has_the_parameters_of_the_paper(network):
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(18.4e6, rel=0.01)


def test_its_trunks_are_densenet_121(network):
    # DenseNet-121 has 7,978,856 parameters, of which its classifier has 1000 x 1024 + 1000.
    for trunk in (network.color, network.height):
        assert sum(p.numel() for p in trunk.parameters()) == 7_978_856 - 1_025_000


@pytest.mark.parametrize("shape", [(16, 16), (48, 32)])
def test_it_gives_the_maps_that_the_fast_network_gives(network, shape):
    x = planes(*shape, seed=1)
    one, other = maps(network, x), maps(QNetwork().eval(), x)
    assert one.shape == other.shape == (1, 2, *shape)
    assert one.dtype == other.dtype == torch.float32


def test_what_moves_by_one_stride_moves_the_maps_by_as_much(network):
    spot = torch.zeros(1, 5, 96, 96)
    spot[:, :, 46:50, 46:50] = 1
    one, other = maps(network, spot), maps(network, spot.roll(16, dims=3))
    # Away from the borders, whose padding every cell's wide view includes to some degree.
    torch.testing.assert_close(one[..., 40:56, 40:56], other[..., 40:56, 56:72], atol=2e-3, rtol=0)
    assert (one[..., 40:56, 40:56] - other[..., 40:56, 40:56]).abs().max() > 5e-3


def test_it_does_not_see_the_plane_of_what_was_seen(network):
    x = planes(16, 16, seed=3).repeat(2, 1, 1, 1)
    x[1, 1] = 1 - x[1, 1]
    q = maps(network, x)
    assert torch.equal(q[0], q[1])


def test_gradients_reach_every_parameter():
    network = PaperNetwork().train()
    q = network(torch.cat([planes(32, 32, seed=6), planes(32, 32, seed=7)]))
    (q[:, 0, 3, 4].sum() + q[:, 1, 14, 3].sum()).backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert silent == []
    for module in (network.color, network.height, network.grasp, network.push):
        assert all(p.grad.any() for p in module.parameters())
