"""Whether a colour image is light and sharp enough to tell objects by."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

# Crete et al., "The blur effect" (2007): the image is blurred once more over so many pixels.
_BLUR_PX = 11


def brightness(color: npt.NDArray[np.uint8]) -> float:
    """Mean grey level, 0..1, of an (H, W, 3) RGB image."""
    return float(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).mean()) / 255


def blur(color: npt.NDArray[np.uint8]) -> float:
    """How blurred an (H, W, 3) RGB image is, 0 sharp to 1: what of its edges remains when it is blurred once more.

    The larger of the two directions (Crete et al., 2007). It says little of an image without edges.
    """
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    worst = 0.0
    for axis, size in ((1, (_BLUR_PX, 1)), (0, (1, _BLUR_PX))):
        again = cv2.blur(gray, size)
        edges, left = np.abs(np.diff(gray, axis=axis)), np.abs(np.diff(again, axis=axis))
        total = float(edges.sum())
        lost = float(np.maximum(0.0, edges - left).sum())
        worst = max(worst, (total - lost) / total if total > 0 else 1.0)
    return worst
