"""What a rollout worker hands to the learner: states, and what was tried in each of them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.io.atomic_file import replaced

if TYPE_CHECKING:
    from pathlib import Path

# Heights are kept as tenths of a millimetre above the lower end of the heightmap's band; 0 = never seen.
_LOWEST_M = -0.10
_UNIT_M = 1e-4


@dataclass(frozen=True)
class Shard:
    """S states and N attempts; heightmaps are (H, W).

    Attributes:
        height: (S, H, W) uint16 with closed gaps, see `pack_height`.
        color: (S, H, W, 3) uint8 RGB.
        labels: (S, H, W) uint8, the object whose cell it is (simulator's truth, 1..), 0 = none. An object has the
            same number in all states of its scene.
        scene: (S,) int32 seed of the scene that the state belongs to.
        state: (N,) int32 state in which the attempt was made.
        primitive: (N,) int8, `policy.network.encoding.GRASP` or `PUSH`.
        row, col: (N,) int16 cell of the Q map.
        rotation: (N,) int8 plane of the Q map, 0..7 for a grasp and 0..15 for a push.
        target: (N,) int16 object that the cell belongs to; the rewards of stage II are those of this object as goal.
        reward: (N, 2) float32 of stage I (goal-agnostic) and of stage II (target as goal).
        next_state: (N,) int32 state after a push, -1 where nothing follows: a grasp ends its episode, and so does a
            push that takes the target out of the workspace.
        greedy: (N,) bool, whether the network chose it (without exploration).
        outcome: (N,) int8, `policy.training.environment.Outcome`.
    """

    height: npt.NDArray[np.uint16]
    color: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.uint8]
    scene: npt.NDArray[np.int32]
    state: npt.NDArray[np.int32]
    primitive: npt.NDArray[np.int8]
    row: npt.NDArray[np.int16]
    col: npt.NDArray[np.int16]
    rotation: npt.NDArray[np.int8]
    target: npt.NDArray[np.int16]
    reward: npt.NDArray[np.float32]
    next_state: npt.NDArray[np.int32]
    greedy: npt.NDArray[np.bool_]
    outcome: npt.NDArray[np.int8]

    def save(self, path: Path) -> None:
        """Write the shard so that a reader sees all of it or nothing."""
        with replaced(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **{field.name: getattr(self, field.name) for field in fields(self)})

    @staticmethod
    def load(path: Path) -> Shard:
        """Read what `save` wrote."""
        # numpy leaves a damaged file open that it opened itself.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return Shard(**{field.name: file[field.name] for field in fields(Shard)})


def pack_height(height_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """Heights [m] with NaN for unknown, as whole tenths of a millimetre; 0 for unknown."""
    units = np.rint((height_m - np.float32(_LOWEST_M)) / np.float32(_UNIT_M)) + 1
    packed: npt.NDArray[np.uint16] = np.nan_to_num(units, nan=0.0).clip(0, 65535).astype(np.uint16)
    return packed


def unpack_height(units: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
    """The inverse of `pack_height`."""
    height: npt.NDArray[np.float32] = (units.astype(np.float32) - 1) * np.float32(_UNIT_M) + np.float32(_LOWEST_M)
    height[units == 0] = np.nan
    return height
