"""A rigid surface of the twin, as a camera sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Kind = Literal["table", "bin", "post", "arm", "gripper", "board", "object"]


@dataclass(frozen=True)
class Visual:
    """A rigid surface as a camera sees it.

    Attributes:
        vertices: (N, 3) float32 [m], in its own frame.
        triangles: (M, 3) int32.
        color: (3,) uint8 RGB.
        kind: what it belongs to.
        object_index: place among `World.objects()`; -1 for everything else.
        texture: (h, w, 3) uint8 RGB, stretched over a rectangle in place of `color`; the four vertices are its corners:
            top left, top right, bottom right, bottom left.
    """

    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]
    color: npt.NDArray[np.uint8]
    kind: Kind
    object_index: int = -1
    texture: npt.NDArray[np.uint8] | None = None
