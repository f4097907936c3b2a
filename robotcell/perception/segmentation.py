"""Which objects lie on the table: object mask and instances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import find_objects

from robotcell.perception.colors import PALETTE, color_features, palette_distances
from robotcell.perception.heightmap import upper_height

if TYPE_CHECKING:
    from robotcell.perception.heightmap import Heightmap

# A cell higher than this holds an object. The paper takes 2 cm, which leaves 5 mm of the lowest block (25 mm)
# for noise and calibration error; 1 cm is still five times the depth noise of a D415 at 1 m (2 mm).
MIN_OBJECT_M = 0.010

# Smaller patches are noise, or the rim of an object in a wrong colour: a third of the smallest face of a
# block (25 x 50 mm), and 6 mm of width.
_SMALLEST_M2 = 400e-6
_NARROWEST_M = 0.006
# Isolated specks below this area are not objects.
_SPECK_M2 = 120e-6
# Colour distances are averaged over this width before a cell takes the nearest colour.
_SMOOTHING_M = 0.010
# Equal colours that touch are two objects where the surface steps by more than this from cell to cell: half
# the lowest block. The steepest smooth face, the roof of the prism, climbs 2 mm per 2 mm cell.
_STEP_M = 0.012
# A neck narrower than this share of the narrower of the two parts that it joins separates equal colours.
_NECK = 0.5

# Cells of an instance that its median colour is taken of.
_MEDIAN_CELLS = 300
# Colour distances beyond this are all the same: one odd cell must not outvote its surroundings.
_FAR = 40.0


@dataclass(frozen=True)
class Instance:
    """One object as the heightmap shows it.

    Attributes:
        label: its number in `Segmentation.labels`, from 1.
        color_name: nearest colour of the palette.
        centroid: (x, y) of its cells, base frame [m].
        height_m: its top above the table (95th percentile of its cells).
        cells: how many cells it covers.
    """

    label: int
    color_name: str
    centroid: tuple[float, float]
    height_m: float
    cells: int


@dataclass(frozen=True)
class Segmentation:
    """The objects of a heightmap.

    Attributes:
        labels: (H, W) int32, 0 where there is no object, else the label of an instance.
        instances: from the largest to the smallest.
    """

    labels: npt.NDArray[np.int32]
    instances: tuple[Instance, ...]

    @property
    def objects(self) -> npt.NDArray[np.bool_]:
        """(H, W) cells that hold an object."""
        return self.labels > 0

    def mask(self, instance: Instance) -> npt.NDArray[np.bool_]:
        """(H, W) cells of one instance."""
        return np.asarray(self.labels == instance.label, np.bool_)


def object_mask(heightmap: Heightmap, min_height_m: float = MIN_OBJECT_M) -> npt.NDArray[np.bool_]:
    """(H, W) cells that rise at least `min_height_m` above the table, without specks."""
    high = (heightmap.filled_m >= min_height_m).astype(np.uint8)
    opened = cv2.morphologyEx(high, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, patches = cv2.connectedComponents(opened, connectivity=4)
    seen = np.bincount(patches[np.isfinite(heightmap.height_m)], minlength=count)
    kept = seen >= _SPECK_M2 / heightmap.workspace.resolution_m**2
    kept[0] = False
    return np.asarray(kept[patches], np.bool_)


def segment(heightmap: Heightmap) -> Segmentation:
    """Separate the objects: touching ones by colour, equal colours by steps in height and by narrow necks."""
    objects = object_mask(heightmap)
    if not objects.any():
        return Segmentation(np.zeros(objects.shape, np.int32), ())
    resolution = heightmap.workspace.resolution_m
    colors = _colors(heightmap, objects)
    labels = _components(colors, objects, _height_steps(heightmap.filled_m))
    labels = _split_necks(labels, resolution)
    labels = _merge_fragments(labels, resolution)
    return _describe(labels, heightmap)


def _colors(heightmap: Heightmap, objects: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """(H, W) index of the palette colour that fits each object cell and its surroundings best."""
    known = objects & np.isfinite(heightmap.height_m)
    features = color_features(heightmap.color[known])
    planes = np.zeros((len(PALETTE), *objects.shape), np.float32)
    # Negative: cells without an object weigh nothing, and the largest sum wins.
    planes[:, known] = np.minimum(palette_distances(features), _FAR) - _FAR
    width = _cells(_SMOOTHING_M, heightmap.workspace.resolution_m) | 1
    for plane in planes:
        cv2.boxFilter(plane, -1, (width, width), dst=plane, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(planes.argmin(axis=0), np.int32)


def _height_steps(heights: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """(H, W) the lower cells at steps."""
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(heights, kernel) - heights > _STEP_M)


def _components(
    colors: npt.NDArray[np.int32], objects: npt.NDArray[np.bool_], cut: npt.NDArray[np.bool_]
) -> npt.NDArray[np.int32]:
    """Connected cells of one colour; the cells of a cut join the nearest component."""
    labels, found = np.zeros(colors.shape, np.int32), 0
    for color in np.flatnonzero(np.bincount(colors[objects])):
        same = objects & (colors == color)
        count, parts = cv2.connectedComponents((same & ~cut).astype(np.uint8), connectivity=4)
        if count == 1:
            count, parts = cv2.connectedComponents(same.astype(np.uint8), connectivity=4)
        np.add(parts, found, out=labels, where=parts > 0)
        found += count - 1
    return _spread(labels, objects)


def _spread(labels: npt.NDArray[np.int32], region: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Give the unlabelled cells of `region` the label of the nearest labelled cell."""
    if not labels.any() or not (region & (labels == 0)).any():
        return labels
    _, nearest = cv2.distanceTransformWithLabels(
        (labels == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label_at = np.zeros(int(nearest.max()) + 1, np.int32)
    label_at[nearest[labels > 0]] = labels[labels > 0]
    return np.where(region, label_at[nearest], np.int32(0))


def _depths(labels: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """(H, W) distance [cells] of each labelled cell to the nearest cell of another label."""
    kernel = np.ones((3, 3), np.uint8)
    plane = labels.astype(np.float32)
    uniform = (cv2.dilate(plane, kernel) == plane) & (cv2.erode(plane, kernel) == plane) & (labels > 0)
    return np.asarray(cv2.distanceTransform(uniform.astype(np.uint8), cv2.DIST_L2, 3))


def _split_necks(labels: npt.NDArray[np.int32], resolution_m: float) -> npt.NDArray[np.int32]:
    """Split components whose parts hang together by a neck."""
    smallest, narrowest = _SMALLEST_M2 / resolution_m**2, _NARROWEST_M / resolution_m
    depths = _depths(labels)
    result: npt.NDArray[np.int32] = labels.copy()
    following = int(labels.max()) + 1
    for label, box in enumerate(find_objects(labels), start=1):
        if box is None:
            continue
        inner, depth = labels[box] == label, depths[box]
        if np.count_nonzero(inner) < 2 * smallest:
            continue
        parts = _necked_parts(inner, np.where(inner, depth, 0), narrowest)
        if parts is None:
            continue
        window = result[box]
        for part in range(2, int(parts.max()) + 1):
            window[inner & (parts == part)] = following
            following += 1
    return result


def _necked_parts(
    whole: npt.NDArray[np.bool_], depth: npt.NDArray[np.float32], narrowest: float
) -> npt.NDArray[np.int32] | None:
    """Parts 1.. of a component that narrows between them, or None."""
    level = narrowest
    while level < depth.max() * _NECK:
        count, cores = cv2.connectedComponents((depth > level).astype(np.uint8), connectivity=8)
        deepest = np.array([depth[cores == part].max() for part in range(1, count)])
        wide = np.flatnonzero(deepest * _NECK >= level) + 1
        if len(wide) > 1:
            return _spread(np.where(np.isin(cores, wide), cores, 0).astype(np.int32), whole)
        level += 1.0
    return None


def _merge_fragments(labels: npt.NDArray[np.int32], resolution_m: float) -> npt.NDArray[np.int32]:
    """Give each patch that is too small or too narrow for an object to the neighbour it touches most."""
    smallest, narrowest = _SMALLEST_M2 / resolution_m**2, _NARROWEST_M / resolution_m
    cells = np.bincount(labels.ravel())
    wide = np.bincount(labels[_depths(labels) >= narrowest / 2], minlength=len(cells)) > 0
    fragments = [n for n in range(1, len(cells)) if cells[n] and (cells[n] < smallest or not wide[n])]
    labels = labels.copy()
    boxes: dict[int, _Box] = {n: (box[0], box[1]) for n, box in enumerate(find_objects(labels), start=1) if box}
    kernel = np.ones((3, 3), np.uint8)
    for fragment in sorted(fragments, key=lambda n: cells[n]):
        box = _grown(boxes[fragment])
        window = labels[box]
        inner = window == fragment
        rim = window[(cv2.dilate(inner.astype(np.uint8), kernel) > 0) & ~inner & (window > 0)]
        if len(rim):
            host = int(np.bincount(rim).argmax())
            window[inner] = host
            boxes[host] = _union(boxes[host], box)
    return labels


def _describe(labels: npt.NDArray[np.int32], heightmap: Heightmap) -> Segmentation:
    """Number the instances from the largest and measure them; those of which no cell was seen are left out."""
    seen = np.isfinite(heightmap.height_m)
    counts = np.bincount(labels[seen])
    counts[0] = 0
    values = np.flatnonzero(counts)
    counts = counts[values]
    order = np.argsort(-counts, kind="stable")
    renumber = np.zeros(int(labels.max()) + 1, np.int32)
    renumber[values[order]] = np.arange(1, len(values) + 1)
    labels = renumber[labels]
    boxes = [(box[0], box[1]) for box in find_objects(labels)]
    masks = [labels[box] == label for label, box in enumerate(boxes, start=1)]
    known = [mask & seen[box] for mask, box in zip(masks, boxes, strict=True)]
    names = _names([heightmap.color[box][cells] for cells, box in zip(known, boxes, strict=True)])
    instances = []
    for i, box in enumerate(boxes):
        rows, cols = np.nonzero(masks[i])
        instances.append(
            Instance(
                label=i + 1,
                color_name=names[i],
                centroid=heightmap.workspace.position(
                    box[0].start + float(rows.mean()), box[1].start + float(cols.mean())
                ),
                height_m=upper_height(heightmap.height_m[box][known[i]], 95),
                cells=len(rows),
            )
        )
    return Segmentation(labels, tuple(instances))


def _names(colors: list[npt.NDArray[np.uint8]]) -> list[str]:
    """The palette colours of instances' (N, 3) cells: of their medians, which noise and rims do not move."""
    if not colors:
        return []
    samples = [cells[:: max(1, len(cells) // _MEDIAN_CELLS)] for cells in colors]
    features = np.split(color_features(np.concatenate(samples)), np.cumsum([len(sample) for sample in samples])[:-1])
    nearest = palette_distances(np.array([np.median(of_one, axis=0) for of_one in features])).argmin(axis=0)
    return [list(PALETTE)[i] for i in nearest]


_Box: TypeAlias = tuple[slice, slice]


def _grown(box: _Box) -> _Box:
    """A box with one more cell on each side; slices end at the edge of the map by themselves."""
    rows, cols = box
    return slice(max(0, rows.start - 1), rows.stop + 1), slice(max(0, cols.start - 1), cols.stop + 1)


def _union(a: _Box, b: _Box) -> _Box:
    """The smallest box that holds both."""
    rows, cols = (slice(min(i.start, j.start), max(i.stop, j.stop)) for i, j in zip(a, b, strict=True))
    return rows, cols


def _cells(length_m: float, resolution_m: float) -> int:
    return max(1, round(length_m / resolution_m))
