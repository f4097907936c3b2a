"""How well an object can be grasped once a push has made room around it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from policy.finger_clearance import OpenGripper, PaddedMaps, finger_clearance, smoothed_tops
from policy.learned.selection import QCells, best_cells, check_maps, smoothed
from policy.network.encoding import GRASP, encode
from policy.push.candidates import thinned

if TYPE_CHECKING:
    from policy.network.inference import Inference
    from policy.push.outcome import PushForwardModel
    from robotcell.perception.heightmap import Heightmap

# Of an object that stood alone, so many grasps are looked at, on cells so far apart; the best of those that have room
# after a push count. One grasp may find room by an error of the prediction, so many do not.
_GRASPS = 80
_SPACING_M = 0.004
_COUNTED = 20


class _Alone(NamedTuple):
    """An object that stands alone in its window: its best grasps, by cells of the window, and its own heights."""

    grasps: QCells
    maps: PaddedMaps


class Graspability:
    """The grasps of the objects of one view, after pushes.

    Args:
        inference: the network.
        model: of the pushes in this view.
        labels: (H, W) the object in each cell, 0 for none.
        heightmap: what is seen.
        gripper: as it comes down.
    """

    def __init__(
        self,
        inference: Inference,
        model: PushForwardModel,
        labels: npt.NDArray[np.integer],
        heightmap: Heightmap,
        gripper: OpenGripper,
    ) -> None:
        self._inference = inference
        self._model = model
        self._labels = labels
        self._heightmap = heightmap
        self._gripper = gripper
        self._objects: dict[int, _Alone] = {}

    def after(self, label: int, around_m: npt.NDArray[np.float32]) -> float:
        """About the chance that an object can be grasped after a push.

        The mean of the best grasps' Q, as if nothing stood around the object, times the clearance of the fingers.

        Args:
            label: of the object.
            around_m: (h, w) heights in its window after the push (`PushForwardModel.height_around`).
        """
        grasps, alone = self._alone(label)
        maps = replace(alone, height_m=around_m, ceiling_m=around_m)
        clearance = finger_clearance(maps, grasps.row, grasps.col, grasps.rotation, self._gripper)
        return float(np.sort(grasps.q * clearance)[-_COUNTED:].mean())

    def _alone(self, label: int) -> _Alone:
        """An object as if all others were gone."""
        if label not in self._objects:
            resolution_m = self._heightmap.workspace.resolution_m
            own, seen = self._labels == label, self._heightmap.color
            bare = np.where(own, self._heightmap.filled_m, np.float32(0))
            table = self._labels == 0
            color = np.median(seen[table], axis=0) if table.any() else np.zeros(3)
            planes = encode(bare, np.where(own[..., None], seen, color.astype(np.uint8)))
            q = self._inference.maps(planes, own, GRASP)
            check_maps(q, own, "grasp")
            apart = thinned(own, round(_SPACING_M / resolution_m))
            best = best_cells(smoothed(q, own, resolution_m), apart, _GRASPS)
            window = self._model.window(label)
            grasps = best._replace(row=best.row - window.top, col=best.col - window.left)
            height_m = self._model.height_alone(label)
            maps = PaddedMaps(
                height_m=height_m,
                ceiling_m=height_m,
                top_m=smoothed_tops(height_m, resolution_m),
                owner=window.own.astype(np.int32),
                pad=0,
                resolution_m=resolution_m,
            )
            self._objects[label] = _Alone(grasps, maps)
        return self._objects[label]
