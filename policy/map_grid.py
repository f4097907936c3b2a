"""The grid of cells that a policy decides on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from robotcell.config import Workspace
    from robotcell.geometry.transforms import Array

# Resolutions that differ by less are the same.
_SAME = 1e-6


def workspace_at(workspace: Workspace, resolution_m: float) -> Workspace:
    """The rectangle of a workspace in cells of that size."""
    return workspace.model_copy(update={"resolution_m": resolution_m})


def check_resolution(shown: Workspace, works_at: Workspace, policy: str) -> None:
    """Refuse a map whose cells are not of the size that a policy works at.

    Raises:
        ConfigError: they are larger or smaller.
    """
    if not math.isclose(shown.resolution_m, works_at.resolution_m, rel_tol=_SAME):
        raise ConfigError(
            f"the policy {policy!r} works on cells of {1000 * works_at.resolution_m:g} mm and is shown a map of "
            f"{1000 * shown.resolution_m:g} mm: build the map with the policy's `workspace`"
        )


def cell_centers(workspace: Workspace, rows: npt.NDArray[np.intp], cols: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Positions x and y [m] of the centres of cells."""
    x = workspace.x[0] + (cols + 0.5) * workspace.resolution_m
    y = workspace.y[0] + (rows + 0.5) * workspace.resolution_m
    return np.asarray(x, np.float64), np.asarray(y, np.float64)
