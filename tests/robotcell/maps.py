"""Heightmaps made by hand."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config import CellConfig, Workspace
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import push_in_workspace
from robotcell.motion.rotations import ROTATIONS
from robotcell.perception.heightmap import Heightmap, TablePlane

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.motion.actions import Action


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


KINDS = ("grasp", "push")


def action(kind: str, x: float, y: float, height_m: float, rotation: int) -> Action:
    """A grasp or a push at a point of the default workspace, of a surface that high above the table."""
    assert 0 <= rotation < ROTATIONS
    if kind == "grasp":
        return Grasp(x, y, height_m, rotation, 0.5)
    return push_in_workspace((x, y), rotation, CellConfig().motion.push_m, height_m, 0.5, Workspace())
