"""Whether the camera still stands where it stood when it was calibrated, by tags that are fixed to the cell.

Camera and tag both stand still, so a tag's corners stay at their pixels: neither the tag's size nor its place is
needed. A tag of the AprilTag family 36h11, anywhere in the view where the arm does not hide it, is enough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from robotcell.config.calibration_file import FixedTag
from robotcell.errors import CalibrationError

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

FAMILY = "DICT_APRILTAG_36h11"
# Two to three times what noise, light and warm-up move a corner by. At 0.9 m a pixel is 1 mm at 1280x720.
MAX_SHIFT_PX = 1.5
# So far around its place a tag is looked for, in sides of the tag.
_AROUND = 1.5


def find_tags(color: npt.NDArray[np.uint8]) -> tuple[FixedTag, ...]:
    """The fixed tags that an (H, W, 3) RGB image shows, in the order of their ids."""
    corners, ids = _detect(_gray(color))
    tags = [FixedTag.model_validate({"id": i, "corners_px": px.tolist()}) for i, px in zip(ids, corners, strict=True)]
    return tuple(sorted(tags, key=lambda tag: tag.id))


def check_tags(color: npt.NDArray[np.uint8], tags: tuple[FixedTag, ...]) -> None:
    """Check that tags are where they were.

    Args:
        color: (H, W, 3) RGB.
        tags: as seen when the camera was calibrated, by this camera at this resolution.

    Raises:
        CalibrationError: one is gone, or elsewhere in the image.
    """
    gray = _gray(color)
    for tag in tags:
        before = np.array(tag.corners_px)
        low, high = before.min(axis=0), before.max(axis=0)
        margin = _AROUND * float((high - low).max())
        left, top = np.maximum(np.floor(low - margin), 0).astype(int)
        right, bottom = np.ceil(high + margin).astype(int)
        corners, ids = _detect(gray[top:bottom, left:right])
        if tag.id not in ids:
            raise CalibrationError(
                f"the fixed tag {tag.id} is not seen near u {before[:, 0].mean():.0f}, v {before[:, 1].mean():.0f} px, "
                "where it was when the camera was calibrated: uncover it, or calibrate again if camera or tag moved"
            )
        shift = np.median(corners[ids.index(tag.id)] + (left, top) - before, axis=0)
        if float(np.hypot(*shift)) > MAX_SHIFT_PX:
            raise CalibrationError(
                f"the fixed tag {tag.id} has moved by {shift[0]:+.1f}, {shift[1]:+.1f} px in the image since the "
                f"camera was calibrated (limit {MAX_SHIFT_PX} px): the camera or the tag was moved, calibrate again"
            )


def _gray(color: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)


def _detect(gray: npt.NDArray[np.uint8]) -> tuple[list[Array], list[int]]:
    """Corners (4, 2) [px] and ids of the tags in a grey image."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(gray)
    if ids is None:
        return [], []
    return [np.asarray(px, np.float64).reshape(4, 2) for px in corners], [int(i) for i in ids.ravel()]
