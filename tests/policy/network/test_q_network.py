import pytest
import torch

from policy.network.paper import PaperNetwork
from policy.network.q_network import QNetwork
from policy.network.registry import NETWORKS, make_network
from robotcell.errors import ConfigError


@pytest.fixture(scope="module")
def network():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return QNetwork()


def noise(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("shape", [(16, 16), (48, 32)])
def test_its_maps_are_as_fine_as_the_heightmap(network, shape):
    q = network(torch.zeros(2, 5, *shape))
    assert q.shape == (2, 2, *shape)
    assert q.dtype == torch.float32


def test_gradients_reach_every_parameter(network):
    network.zero_grad()
    network.train()(noise(2, 5, 32, 32)).square().mean().backward()
    assert [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_a_map_sees_what_is_beside_its_cell(network):
    x = noise(1, 5, 64, 64)
    other = x.clone()
    other[:, 0, 40:44, 32] += 1
    with torch.no_grad():
        one, two = network.eval()(x), network.eval()(other)
    assert (one[:, :, 32, 32] != two[:, :, 32, 32]).all()


def test_networks_go_by_name():
    assert {name: type(make_network(name)) for name in NETWORKS} == {"fast": QNetwork, "paper": PaperNetwork}


def test_an_unknown_network_lists_those_that_exist():
    with pytest.raises(ConfigError, match="no network is called 'deep'; there is: fast, paper"):
        make_network("deep")
