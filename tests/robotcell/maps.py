"""Heightmaps made by hand."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config import Workspace
from robotcell.motion.rotations import ROTATIONS
from robotcell.jobs.policy_api import Action, Primitive
from robotcell.perception.heightmap import Heightmap, TablePlane

if TYPE_CHECKING:
    import numpy.typing as npt


def heightmap(height_m: npt.NDArray[np.float32] | None = None, workspace: Workspace | None = None) -> Heightmap:
    """A heightmap of given heights, flat by default, all of it grey."""
    workspace = workspace or Workspace()
    heights = np.zeros(workspace.shape, np.float32) if height_m is None else height_m
    return Heightmap(
        workspace=workspace,
        color=np.full((*workspace.shape, 3), 90, np.uint8),
        height_m=heights,
        table=TablePlane(tilt_rad=0.0, offset_m=0.0, rms_m=0.0),
        coverage=1.0,
        masks=MappingProxyType({}),
        t=0.0,
    )


def action(primitive: Primitive, x: float, y: float, z: float, rotation: int) -> Action:
    """An action at a point of the default workspace."""
    assert 0 <= rotation < ROTATIONS
    row, col = Workspace().cell(x, y)
    return Action(primitive, row, col, rotation, (x, y, z), 0.5)
