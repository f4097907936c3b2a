"""The networks by name, as the weights and the command line call them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from policy.network.paper import PaperNetwork
from policy.network.q_network import QNetwork
from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import nn

NETWORKS: dict[str, Callable[[], nn.Module]] = {"fast": QNetwork, "paper": PaperNetwork}


def make_network(name: str) -> nn.Module:
    """A network of that architecture with fresh weights.

    Raises:
        ConfigError: there is none; the message lists those that exist.
    """
    if name not in NETWORKS:
        raise ConfigError(f"no network is called {name!r}; there is: {', '.join(sorted(NETWORKS))}")
    return NETWORKS[name]()
