"""What a push is good for: how well its object can be grasped once the push has made room around it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from policy.grasp_room import Jaw, Table, finger_room
from policy.learned.selection import Cells, best_cells, check_maps, faded, thinned
from policy.network.encoding import encode
from policy.network.q_network import GRASP

if TYPE_CHECKING:
    from policy.network.inference import Inference
    from policy.push.outcome import Foresight
    from robotcell.perception.heightmap import Heightmap

# Of an object that stood alone, so many grasps are looked at, on cells so far apart; the best of those that have room
# after a push count. One grasp may find room by an error of the played push, so many do not.
_GRASPS = 80
_APART = 2
_COUNTED = 20


class _Alone(NamedTuple):
    """An object that stands alone in its window: its best grasps, by cells of the window, and its own surface."""

    grasps: Cells
    table: Table


class Prospects:
    """The grasps of the objects of one view, after pushes.

    Args:
        inference: the network.
        foresight: of the view.
        labels: (H, W) the object in each cell, 0 for none.
        heightmap: what is seen.
        jaw: of the gripper.
    """

    def __init__(
        self,
        inference: Inference,
        foresight: Foresight,
        labels: npt.NDArray[np.integer],
        heightmap: Heightmap,
        jaw: Jaw,
    ) -> None:
        self._inference = inference
        self._foresight = foresight
        self._labels = labels
        self._heightmap = heightmap
        self._jaw = jaw
        self._objects: dict[int, _Alone] = {}

    def after(self, label: int, around: npt.NDArray[np.float32]) -> float:
        """About the chance that an object can be grasped after a push.

        The mean of the best grasps' Q, as if nothing stood around the object, times the room that the fingers find.

        Args:
            label: of the object.
            around: what the push makes of its window (`Foresight.around`).
        """
        grasps, alone = self._alone(label)
        table = replace(alone, height_m=around, ceiling_m=around)
        room = finger_room(table, grasps.row, grasps.col, grasps.rotation, self._jaw)
        return float(np.sort(grasps.q * room)[-_COUNTED:].mean())

    def _alone(self, label: int) -> _Alone:
        """An object as if all others were gone."""
        if label not in self._objects:
            own, seen = self._labels == label, self._heightmap.color
            bare = np.where(own, self._heightmap.filled(), np.float32(0))
            table = self._labels == 0
            color = np.median(seen[table], axis=0) if table.any() else np.zeros(3)
            planes = encode(bare, np.where(own[..., None], seen, color.astype(np.uint8)))
            q = self._inference.maps(planes, own, GRASP)
            check_maps(q, own, "grasp")
            best = best_cells(faded(q, own), thinned(own, _APART), _GRASPS)
            window = self._foresight.window(label)
            grasps = best._replace(row=best.row - window.top, col=best.col - window.left)
            height_m = self._foresight.alone(label)
            surface = Table(
                height_m=height_m,
                ceiling_m=height_m,
                top_m=np.asarray(cv2.medianBlur(height_m, 5), np.float32),
                owner=window.own.astype(np.int32),
                pad=0,
                resolution_m=self._heightmap.workspace.resolution_m,
            )
            self._objects[label] = _Alone(grasps, surface)
        return self._objects[label]
