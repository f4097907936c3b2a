"""Whether the open fingers of a grasp come down without touching anything."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.config.fingers import gripper_range
from robotcell.geometry import rg2
from robotcell.motion.grasp import GRASP_DEPTH_M
from robotcell.motion.rotations import GRASP_ROTATIONS, rotation_angle_rad

if TYPE_CHECKING:
    from policy.shadows import CompletedHeights
    from robotcell.config import CellConfig

# Fingers keep this distance from what they pass, over their own size: calibration, depth noise, half a cell.
_SIDE_MARGIN_M = 0.003
# The open tips must end at least this far above what is beneath them, and are at ease twice as far.
_TIP_MARGIN_M = 0.004
# Samples of a grasp reach so far from its centre along and across the closing axis, if its fingers reach no farther.
SAMPLED_M = 0.050
_PAD_MARGIN_M = 0.010
# The top of an object is taken from all cells so far around; of float32, OpenCV takes the median of 5 x 5 at most.
_TOP_M = 0.004
_MEDIAN_CELLS = 5


@dataclass(frozen=True)
class OpenGripper:
    """The gripper as it comes down for a grasp.

    Attributes:
        opening_m: pre-shaped opening between the tips.
        tip_clearance_m: lowest height of the tcp above the table.
        fingertip_offset_m: how far each mounted tip reaches inwards from the bare finger.
    """

    opening_m: float
    tip_clearance_m: float
    fingertip_offset_m: float = 0.0

    @classmethod
    def of(cls, config: CellConfig) -> OpenGripper:
        """That of a cell."""
        use = config.gripper
        return cls(use.preshape_m, use.tip_clearance_m, gripper_range(config).fingertip_offset_m)

    @property
    def thickness_m(self) -> float:
        """Of a finger with its tip."""
        return rg2.finger_thickness(self.fingertip_offset_m)


@dataclass(frozen=True)
class PaddedMaps:
    """Maps padded so that every sample of a grasp at a cell of the heightmap falls inside.

    Attributes:
        height_m, ceiling_m, top_m: (H', W') likely, greatest and smoothed height; beyond the map the floor, of
            which nothing is known.
        owner: (H', W') label of the object in each cell, 0 for none.
        pad: cells added on each side.
        resolution_m: size of a cell.
    """

    height_m: npt.NDArray[np.float32]
    ceiling_m: npt.NDArray[np.float32]
    top_m: npt.NDArray[np.float32]
    owner: npt.NDArray[np.int32]
    pad: int
    resolution_m: float

    def flat_index(self, row: npt.NDArray[np.intp], col: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """(N,) place in the flattened maps of cells (N,) of the heightmap."""
        return np.asarray((row + self.pad) * self.height_m.shape[1] + col + self.pad, np.intp)


def pad_maps(
    heights: CompletedHeights, owner: npt.NDArray[np.int32], resolution_m: float, gripper: OpenGripper
) -> PaddedMaps:
    """Pad the heights and the labels of the objects for grasps with that gripper."""
    reach = math.hypot(max(gripper.opening_m / 2 + gripper.thickness_m, SAMPLED_M), SAMPLED_M) + _PAD_MARGIN_M
    pad = math.ceil(reach / resolution_m)
    return PaddedMaps(
        height_m=np.pad(heights.height_m, pad),
        ceiling_m=np.pad(heights.ceiling_m, pad, constant_values=1.0),
        top_m=np.pad(smoothed_tops(heights.height_m, resolution_m), pad),
        owner=np.pad(owner, pad),
        pad=pad,
        resolution_m=resolution_m,
    )


def smoothed_tops(height_m: npt.NDArray[np.float32], resolution_m: float) -> npt.NDArray[np.float32]:
    """(H, W) the median of the heights (H, W) around each cell: noise and flying pixels left out."""
    size = min(2 * round(_TOP_M / resolution_m) + 1, _MEDIAN_CELLS)
    return np.asarray(cv2.medianBlur(height_m, size), np.float32)


def finger_reach_m(gripper: OpenGripper) -> float:
    """Distance [m] from the centre of a grasp to the farthest corner that a finger needs room at."""
    along = gripper.opening_m / 2 + gripper.thickness_m + _SIDE_MARGIN_M
    return math.hypot(along, rg2.FINGER_BREADTH_M / 2 + _SIDE_MARGIN_M)


def tcp_height_m(
    maps: PaddedMaps, row: npt.NDArray[np.intp], col: npt.NDArray[np.intp], gripper: OpenGripper
) -> npt.NDArray[np.float32]:
    """(N,) height of the tcp above the table of grasps at cells (N,)."""
    tops = maps.top_m.ravel()[maps.flat_index(row, col)]
    return np.asarray(np.maximum(tops - GRASP_DEPTH_M, gripper.tip_clearance_m), np.float32)


def finger_clearance(
    maps: PaddedMaps,
    row: npt.NDArray[np.intp],
    col: npt.NDArray[np.intp],
    rotation: npt.NDArray[np.intp],
    gripper: OpenGripper,
) -> npt.NDArray[np.float32]:
    """(N,) 0..1: whether the open fingers of grasps at (N,) cells and rotations come down without touching anything."""
    center = maps.flat_index(row, col)
    tip = tcp_height_m(maps, row, col, gripper) + np.float32(
        rg2.tip_retraction(gripper.opening_m, gripper.fingertip_offset_m)
    )
    stride = maps.height_m.shape[1]
    bare = _finger_offsets(stride, maps.resolution_m, gripper, 0.0)
    wide = _finger_offsets(stride, maps.resolution_m, gripper, _SIDE_MARGIN_M)
    heights, ceilings = maps.height_m.ravel(), maps.ceiling_m.ravel()
    free = tip - heights[center[:, None] + bare[rotation]].max(axis=1)
    clearance = np.zeros(len(center), np.float32)
    fits = np.flatnonzero(free > _TIP_MARGIN_M)
    at = center[fits, None] + wide[rotation[fits]]
    free_around = tip[fits] - heights[at].max(axis=1)
    ease = 0.5 + 0.5 * np.clip(free_around / _TIP_MARGIN_M - 1, 0, 1)
    doubtful = (ceilings[at] > tip[fits, None] - _TIP_MARGIN_M).mean(axis=1)
    clearance[fits] = ease * (1 - 0.5 * doubtful)
    return clearance


def grid_offsets(
    rotation: int,
    along_m: npt.NDArray[np.floating],
    across_m: npt.NDArray[np.floating],
    stride: int,
    resolution_m: float,
) -> npt.NDArray[np.intp]:
    """Flat offsets of a grid of samples along and across a closing direction, the line across varying slowest.

    Args:
        rotation: index of the closing direction.
        along_m: of the samples from the centre of the grasp.
        across_m: likewise.
        stride: cells in a row of the map.
        resolution_m: size of a cell.
    """
    theta = rotation_angle_rad(rotation)
    u, v = np.meshgrid(along_m, across_m)
    cols = np.rint((u * math.cos(theta) - v * math.sin(theta)) / resolution_m)
    rows = np.rint((u * math.sin(theta) + v * math.cos(theta)) / resolution_m)
    return np.asarray(rows * stride + cols, np.intp).ravel()


@lru_cache(maxsize=64)
def _finger_offsets(stride: int, resolution_m: float, gripper: OpenGripper, margin_m: float) -> npt.NDArray[np.intp]:
    """(K, N) flat offsets of the cells under both fingers, from the centre of the grasp, in every direction."""
    half = gripper.thickness_m / 2
    along = _spaced(half + margin_m, resolution_m) + gripper.opening_m / 2 + half
    across = _spaced(rg2.FINGER_BREADTH_M / 2 + margin_m, resolution_m)
    both = np.concatenate([along, -along])
    return np.stack([grid_offsets(k, both, across, stride, resolution_m) for k in range(GRASP_ROTATIONS)])


def _spaced(half_m: float, resolution_m: float) -> npt.NDArray[np.floating]:
    """Offsets from -half to half, a cell and a half apart at most."""
    return np.linspace(-half_m, half_m, max(2, math.ceil(2 * half_m / (1.5 * resolution_m)) + 1))
