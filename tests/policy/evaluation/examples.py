"""Results and settings made up for tests."""

from __future__ import annotations

from typing import Any

from policy.evaluation.benchmark import Origin, Settings
from policy.evaluation.trials import TrialResult
from robotcell.config import CellConfig

ORIGIN = Origin("2026-01-01T00:00:00+00:00", {"robotcell": "0.1.0"})


def result(**values: Any) -> TrialResult:
    """A run for one goal unless told otherwise."""
    known = {"suite": "random", "scene": "random-goal", "seed": 0, "policy": "heuristic", "goal": "red"}
    return TrialResult(**{**known, "scene_seed": 0, "command": "robotcell pick", **values})


def run(attempts: int, pushes: int = 0, *, completed: bool = True, **values: Any) -> TrialResult:
    """A run with so many grasps, of which the last one picked the goal if it is complete."""
    return result(
        completed=completed,
        true_completed=completed,
        actions=attempts + pushes,
        pushes=pushes,
        grasp_attempts=attempts,
        grasp_successes=int(completed),
        **values,
    )


def settings(**values: Any) -> Settings:
    """Settings of one suite with one policy."""
    known = {"suites": ("random",), "policies": ("heuristic",), "trials": 1, "seed": 0}
    return Settings(**{**known, "scenes": None, "meshes": None, "cell_file": None, "cell": CellConfig(), **values})
