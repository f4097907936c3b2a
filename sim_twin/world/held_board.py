"""The calibration board in the twin: a plate that the closed fingers hold by its tab. Seen, but never touched.

How exactly it is held is drawn from the seed, and whoever calibrates has to find out.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from robotcell.geometry.transforms import Array, make_transform, transform_points
from robotcell.perception.board_plate import DEFAULT_BOARD, PLATE_M, TAB_M, draw_plate, held_by_gripper, plate_corners
from sim_twin.visual import Visual

# By hand, a plate is put between the fingers about so well (assumed).
_POSITION_RMS_M = 0.002
_ROTATION_RMS_RAD = 0.02
# Fine enough that a pixel of the camera (0.5 mm and more on the board) sees no steps.
_TEXTURE_PX_PER_MM = 4
# The four corners of the tab in order round it, and where the back of the plate is.
_AROUND = [0, 2, 3, 1]
_BACK = (0.0, 0.0, PLATE_M)
_INK, _PAPER = 30, 225
_PLATE_COLOR = (205, 205, 200)


def T_flange_board(seed: int) -> Array:  # noqa: N802 (notation of the field)
    """How the board is really held (4, 4), for scores and tests only."""
    rng = np.random.default_rng([seed, 0xB0A2D])
    T = held_by_gripper(DEFAULT_BOARD)
    off = make_transform(
        Rotation.from_rotvec(rng.normal(scale=_ROTATION_RMS_RAD, size=3)).as_matrix(),
        rng.normal(scale=_POSITION_RMS_M, size=3),
    )
    return np.asarray(T @ off)


def board_visuals(seed: int) -> tuple[Visual, Visual]:
    """The printed face, and the other sides of the plate, in the frame of the flange."""
    T = T_flange_board(seed)
    face = plate_corners(DEFAULT_BOARD)
    tab_width, tab_length = TAB_M
    middle, bottom = face[2:].mean(axis=0)[0], face[2, 1]
    tab = np.array([(middle + x, bottom + y, 0.0) for x in (-tab_width / 2, tab_width / 2) for y in (0, tab_length)])
    # Neither ink nor paper is perfect.
    drawn = np.where(draw_plate(DEFAULT_BOARD, _TEXTURE_PX_PER_MM) > 127, _PAPER, _INK).astype(np.uint8)
    plate = np.array(_PLATE_COLOR, np.uint8)
    slabs = np.vstack([face, face + _BACK, tab[_AROUND], tab[_AROUND] + _BACK])
    sides = [(i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4) for i in range(4)]
    quads = [
        *sides,
        (4, 5, 6, 7),
        *((a + 8, b + 8, c + 8, d + 8) for a, b, c, d in (*sides, (0, 1, 2, 3), (4, 5, 6, 7))),
    ]
    return (
        _quads(transform_points(T, face), [(0, 1, 2, 3)], plate, drawn[..., None].repeat(3, axis=2)),
        _quads(transform_points(T, slabs), quads, plate, None),
    )


def _quads(
    vertices: npt.NDArray[np.floating],
    quads: list[tuple[int, int, int, int]],
    color: npt.NDArray[np.uint8],
    texture: npt.NDArray[np.uint8] | None,
) -> Visual:
    triangles = np.array([half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))], np.int32)
    return Visual(vertices.astype(np.float32), triangles, color, "board", texture=texture)
