"""Policies: what to do next, given what the camera saw."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.config import CellConfig
    from robotcell.decision import Policy


def make_policy(name: str, config: CellConfig) -> Policy:
    """The policy of that name for a cell.

    Raises:
        ConfigError: there is none; the message lists those that exist.
    """
    if name not in _MAKERS:
        raise ConfigError(f"no policy is called {name!r}; there is: {', '.join(sorted(_MAKERS))}")
    return _MAKERS[name](config)


def _heuristic(config: CellConfig) -> Policy:
    from policy.heuristic import HeuristicPolicy

    return HeuristicPolicy(config)


def _random(config: CellConfig) -> Policy:
    from policy.random_policy import RandomPolicy

    return RandomPolicy(config)


_MAKERS: dict[str, Callable[[CellConfig], Policy]] = {"heuristic": _heuristic, "random": _random}
