"""Names of colours: the ten that objects are told apart by, and the words of CSS mapped onto them as an eye would."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
from PIL import ImageColor
from scipy.spatial.distance import cdist

# RGB, 0..255: the colours that the block scenes of the push-grasp papers share.
PALETTE: dict[str, tuple[int, int, int]] = {
    "blue": (78, 121, 167),
    "green": (89, 161, 79),
    "brown": (156, 117, 95),
    "orange": (242, 142, 43),
    "yellow": (237, 201, 72),
    "gray": (186, 176, 172),
    "red": (255, 87, 89),
    "purple": (176, 122, 161),
    "cyan": (118, 183, 178),
    "pink": (255, 157, 167),
}

# Colours are compared by CIELAB a and b as they would be at this lightness, which a shadow or an exposure
# does not change (scaling the light scales a, b and L + 16 alike), and by lightness with less weight. In 4000
# draws a weight of 0.2 to 0.4 named every colour right under 6 % of drift per channel and shading to 60 %.
# The table is no reference for the white balance, since a real one need not be neutral.
_LIGHTNESS = 66.0
_LIGHTNESS_WEIGHT = 0.3


def color_features(colors: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """(N, 3) perceptual coordinates of (N, 3) RGB colours, N > 0."""
    lab = cv2.cvtColor(colors[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    lightness = lab[:, 0]
    at_equal_light = lab[:, 1:] * ((_LIGHTNESS + 16) / (lightness[:, None] + 16))
    return np.column_stack([at_equal_light, _LIGHTNESS_WEIGHT * lightness])


def palette_distances(features: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(colours, N) perceptual distances of the palette's colours to (N, 3) features."""
    return np.asarray(cdist(_palette_features(), features), np.float32)


def word_to_rgb(word: str) -> tuple[int, int, int] | None:
    """RGB, 0..255, of a colour word in any case: the palette's own, or CSS's; None for a word that is neither.

    The CSS colours are those of Pillow's `ImageColor.colormap`.
    """
    name = word.lower()
    if name in PALETTE:
        return PALETTE[name]
    if name not in ImageColor.colormap:
        return None
    red, green, blue = ImageColor.getrgb(name)[:3]
    return red, green, blue


def palette_name(word: str) -> str | None:
    """The palette's colour that an eye takes a colour word for; None for a word that is no colour."""
    name = word.lower()
    if name in PALETTE:
        return name
    rgb = word_to_rgb(name)
    if rgb is None:
        return None
    return list(PALETTE)[int(palette_distances(color_features(np.array([rgb], np.uint8))).argmin())]


@lru_cache(maxsize=1)
def _palette_features() -> npt.NDArray[np.float32]:
    return color_features(np.array(list(PALETTE.values()), np.uint8))
