"""The forward model of pushes: where the objects come to stand, and what is then seen around them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import find_objects

from policy.push.border import border_cells, is_occupied
from policy.push.physics import PlanarPhysics, Prism
from robotcell.motion.rotations import rotation_angle_rad
from robotcell.perception.heightmap import upper_height
from robotcell.perception.segmentation import MIN_OBJECT_M

if TYPE_CHECKING:
    from policy.push.line import PushLine
    from robotcell.geometry.transforms import Array
    from robotcell.perception.heightmap import Heightmap

# What is pushed nearer to the rim of the map than this, and not just along it, may leave it or leaves no room for a
# finger.
_RIM_M = 0.03
# The window of an object shows so much around it: farther than fingers that grasp it reach, and than its border.
_AROUND_M = 0.07
# An outline is where most of what is so far around was seen to be the object's.
_SPECKS_M = 0.010
_STAYS = np.eye(3)
# The fingers pass over what is lower than their tips, with so much to spare.
_CLEAR_M = 0.002


@dataclass(frozen=True)
class PushOutcome:
    """What came of a push.

    Attributes:
        moves: by label of each object that moved, see `policy.push.physics.PlanarPhysics.push`.
        lost: labels of those that came so near to the rim of the workspace that they may leave it.
    """

    moves: dict[int, Array]
    lost: frozenset[int]


_NOTHING = PushOutcome({}, frozenset())


class Window(NamedTuple):
    """The part of the map around an object.

    Attributes:
        top, left: row and column of the map at its first cell; negative where it reaches beyond the map.
        own: (h, w) cells of the object.
        border: (N, 2) row and column, in the window, of the cells around the object.
    """

    top: int
    left: int
    own: npt.NDArray[np.bool_]
    border: npt.NDArray[np.intp]


class PushForwardModel:
    """The objects of one view, and what a push makes of them.

    Args:
        labels: (H, W) the object in each cell, 0 for none.
        heightmap: what is seen.
    """

    def __init__(self, labels: npt.NDArray[np.integer], heightmap: Heightmap) -> None:
        self._height_m = heightmap.filled_m
        self._seen = np.isfinite(heightmap.height_m)
        self._resolution_m = heightmap.workspace.resolution_m
        self._pad = math.ceil(_AROUND_M / self._resolution_m)
        boxes = find_objects(labels)
        self._cells = {i: (box, labels[box] == i) for i, box in enumerate(boxes, start=1) if box is not None}
        self._alone = {i: np.where(own, self._height_m[box], np.float32(0)) for i, (box, own) in self._cells.items()}
        self._prisms = {i: prism for i in self._cells if (prism := self._prism(i)) is not None}
        self._physics = PlanarPhysics(self._prisms)
        self._windows: dict[int, Window] = {}
        self._occupied: dict[int, float] = {}

    def predict(self, line: PushLine, rotation: int) -> PushOutcome:
        """What the closed fingers do that move along a push."""
        start = (np.array([line.col, line.row]) + 0.5) * self._resolution_m
        length_m = (len(line.cells) - 1) * self._resolution_m
        # The paper pushes at half of the height of what is met.
        moves = self._physics.push(start, rotation_angle_rad(rotation), length_m, line.top_m / 2 + _CLEAR_M)
        lost = frozenset(i for i, move in moves.items() if self._may_be_lost(self._prisms[i], move))
        return PushOutcome(moves, lost)

    def window(self, label: int) -> Window:
        """What is seen of an object and of what stands around it."""
        if label not in self._windows:
            (rows, cols), own = self._cells[label]
            shown = np.pad(own, self._pad)
            self._windows[label] = Window(
                rows.start - self._pad, cols.start - self._pad, shown, border_cells(shown, self._resolution_m)
            )
        return self._windows[label]

    def height_alone(self, label: int) -> npt.NDArray[np.float32]:
        """(h, w) heights in the window of an object if there were no other."""
        return np.pad(self._alone[label], self._pad)

    def height_around(self, label: int, outcome: PushOutcome) -> npt.NDArray[np.float32]:
        """(h, w) heights in the window of an object after a push; the window goes and turns with the object."""
        window = self.window(label)
        here = outcome.moves.get(label, _STAYS)
        others = {other: move for other, move in outcome.moves.items() if other != label}
        heights = self._after((window.top, window.left), window.own.shape, here, others, {*others, label})
        np.copyto(heights, self.height_alone(label), where=window.own)
        return heights

    def uncovered_share(self, cells: npt.NDArray[np.bool_], outcome: PushOutcome) -> float:
        """Share of cells (H, W) on which nothing stands any more after a push."""
        heights = self._after((0, 0), cells.shape, _STAYS, outcome.moves, set(outcome.moves))
        return float((heights[cells] < MIN_OBJECT_M).mean())

    def border_gain(self, label: int, around_m: npt.NDArray[np.float32]) -> float:
        """How much of an object's border a push frees: the fall in the share that others stand on (paper, stage II).

        Args:
            label: of the object.
            around_m: (h, w) heights in its window after the push (`height_around`).
        """
        if label not in self._occupied:
            self._occupied[label] = self._share(label, self.height_around(label, _NOTHING))
        return self._occupied[label] - self._share(label, around_m)

    def _share(self, label: int, around_m: npt.NDArray[np.float32]) -> float:
        rows, cols = self.window(label).border.T
        return float(is_occupied(around_m[rows, cols]).mean())

    def _after(
        self,
        corner: tuple[int, int],
        size: tuple[int, ...],
        here: Array,
        moves: dict[int, Array],
        gone: set[int],
    ) -> npt.NDArray[np.float32]:
        """(h, w) heights after a push in a window of the map.

        Args:
            corner: row and column of the map at its first cell.
            size: its rows and columns.
            here: the window's own move.
            moves: of the objects that are shown where they came to.
            gone: labels of those that are not shown where they were.
        """
        rest = self._height_m.copy()
        for label in gone:
            box, cells = self._cells[label]
            rest[box][cells] = 0.0
        heights = self._warped(rest, (0, 0), here, corner, size)
        back = _inverse(here)
        for label, move in moves.items():
            prism = self._prisms[label]
            way = back @ move
            # Only the part of the window that it may come to is looked at.
            col, row = (way[:2, :2] @ prism.center + way[:2, 2]) / self._resolution_m - corner[::-1]
            reach = prism.reach_m / self._resolution_m + 2
            top, left = max(0, math.floor(row - reach)), max(0, math.floor(col - reach))
            part = heights[top : max(0, math.ceil(row + reach)), left : max(0, math.ceil(col + reach))]
            if part.size:
                (rows, cols), _ = self._cells[label]
                place = (corner[0] + top, corner[1] + left)
                shown = self._warped(self._alone[label], (rows.start, cols.start), _inverse(way), place, part.shape)
                np.maximum(part, shown, out=part)
        return heights

    def _warped(
        self,
        height_m: npt.NDArray[np.float32],
        start: tuple[int, int],
        way: Array,
        corner: tuple[int, int],
        size: tuple[int, ...],
    ) -> npt.NDArray[np.float32]:
        """A part of the map, its first cell at `start`, as a window shows it; `way` (3, 3) from window to part."""
        cells = way[:2].copy()
        cells[:, 2] /= self._resolution_m
        cells[:, 2] += cells[:, :2] @ (corner[1] + 0.5, corner[0] + 0.5)
        cells[:, 2] -= start[1] + 0.5, start[0] + 0.5
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(height_m, cells, size[::-1], flags=flags), np.float32)

    def _prism(self, label: int) -> Prism | None:
        box, own = self._cells[label]
        height_m = upper_height(self._height_m[box][own], 90)
        solid = _without_specks(own, self._seen[box], self._resolution_m)
        return Prism.of(solid, (box[0].start, box[1].start), height_m, self._resolution_m)

    def _may_be_lost(self, prism: Prism, move: Array) -> bool:
        middle = move[:2, :2] @ prism.center + move[:2, 2]
        if self._margin(middle) - prism.reach_m > _RIM_M:
            return False
        outline = np.concatenate(prism.parts)
        before = self._margin(outline + prism.center)
        return self._margin(outline @ move[:2, :2].T + middle) < min(_RIM_M, before - self._resolution_m)

    def _margin(self, places: Array) -> float:
        """Distance [m] of x and y (..., 2) from the rim of the map, negative beyond it."""
        size = np.array(self._height_m.shape[::-1]) * self._resolution_m
        return float(min(places.min(), (size - places).min()))


def _without_specks(
    own: npt.NDArray[np.bool_], seen: npt.NDArray[np.bool_], resolution_m: float
) -> npt.NDArray[np.bool_]:
    """Cells (h, w) of an object without the specks that the camera sees of it in the shadow behind it."""
    size = 2 * round(_SPECKS_M / resolution_m / 2) + 1
    share = cv2.boxFilter((own & seen).astype(np.float32), -1, (size, size), borderType=cv2.BORDER_CONSTANT)
    dense = own & (share > 0.5)
    # What is narrow all over has no inside.
    return dense if 4 * np.count_nonzero(dense) > np.count_nonzero(own) else own


def _inverse(move: Array) -> Array:
    back: Array = move.copy()
    back[:2, :2] = move[:2, :2].T
    back[:2, 2] = -back[:2, :2] @ move[:2, 2]
    return back
