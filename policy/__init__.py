"""Policies: what to do next, given what the camera saw."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.config import CellConfig
    from robotcell.jobs.policy_api import Policy


def make_policy(name: str, config: CellConfig) -> Policy:
    """The policy of that name for a cell.

    Raises:
        ConfigError: there is none; the message lists those that exist.
    """
    if name not in _MAKERS:
        raise ConfigError(f"no policy is called {name!r}; there is: {', '.join(sorted(_MAKERS))}")
    return _MAKERS[name](config)


def _heuristic(config: CellConfig) -> Policy:
    from policy.heuristic.policy import HeuristicPolicy

    return HeuristicPolicy(config)


def _random(config: CellConfig) -> Policy:
    from policy.random_policy import RandomPolicy

    return RandomPolicy(config)


def _learned(config: CellConfig) -> Policy:
    return _of_weights("learned", "learned", config)


def _grasp_only(config: CellConfig) -> Policy:
    return _of_weights("grasp-only", "learned", config, may_push=False)


def _single_stage(config: CellConfig) -> Policy:
    return _of_weights("single-stage", "single-stage", config)


def _of_weights(name: str, weights: str, config: CellConfig, *, may_push: bool = True) -> Policy:
    """A policy of weights that come with the package."""
    from policy.learned.policy import LearnedPolicy
    from policy.network.inference import Inference
    from policy.network.weights import load_named

    return LearnedPolicy(config, Inference(load_named(weights)[0]), name, may_push=may_push)


_MAKERS: dict[str, Callable[[CellConfig], Policy]] = {
    "learned": _learned,
    "grasp-only": _grasp_only,
    "single-stage": _single_stage,
    "heuristic": _heuristic,
    "random": _random,
}
