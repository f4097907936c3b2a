"""The board's corners in an image, and which images are worth keeping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from calibration.solve.views import Corners
from robotcell.perception.board_plate import opencv_board

if TYPE_CHECKING:
    from robotcell.config.calibration_file import CharucoBoard

Bytes = npt.NDArray[np.uint8]

# A third of the default board. Fewer say little about its tilt, and are more likely to be false.
MIN_CORNERS = 8
# The corners must reach over this many rows and columns of the board.
_MIN_LINES = 3
# A corner nearer to the border of the image was refined in a window that is cut off [px].
_BORDER_PX = 6
_NOT_FOUND = "the board was not found"


@dataclass(frozen=True)
class Detection:
    """What an image shows of the board.

    Attributes:
        corners: in the image; those of a refused image too.
        refused: why the image is of no use; "" if it is.
    """

    corners: Corners
    refused: str


class Detector:
    """Finds the corners of one board.

    Raises:
        ConfigError: OpenCV has no such board.
    """

    def __init__(self, board: CharucoBoard) -> None:
        self._board = board
        self._detector = cv2.aruco.CharucoDetector(opencv_board(board))

    def detect(self, color: Bytes) -> Detection:
        """The corners of an (H, W, 3) RGB image, refined to a fraction of a pixel."""
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        found_px, found_ids, _, _ = self._detector.detectBoard(gray)
        if found_ids is None or found_px is None:
            return Detection(Corners(np.zeros(0, np.int64), np.zeros((0, 2))), _NOT_FOUND)
        ids = np.asarray(found_ids, np.int64).ravel()
        px = np.asarray(found_px, np.float64).reshape(-1, 2)
        height, width = gray.shape
        inside = ((px >= _BORDER_PX) & (px <= (width - 1 - _BORDER_PX, height - 1 - _BORDER_PX))).all(axis=1)
        corners = Corners(ids[inside], px[inside])
        return Detection(corners, self.refuse(corners))

    def refuse(self, corners: Corners) -> str:
        """Why these corners are of no use; "" if they are."""
        ids = corners.ids
        if not len(ids):
            return _NOT_FOUND
        if len(ids) < MIN_CORNERS:
            return f"{len(ids)} corners of the board are seen, and {MIN_CORNERS} are needed"
        columns = self._board.squares_x - 1
        lines = min(len(np.unique(ids // columns)), len(np.unique(ids % columns)))
        if lines < min(_MIN_LINES, columns, self._board.squares_y - 1):
            return f"the corners lie on {lines} line(s) of the board, which leaves its tilt open"
        return ""


def average(detections: list[Corners]) -> tuple[Corners, float]:
    """The corners that all images of one view show, their mean places, and how far the places wander [px].

    The wandering is the largest distance of a corner's place from its mean: more than noise makes means that arm,
    board or camera moved between the images.
    """
    ids = detections[0].ids
    for other in detections[1:]:
        ids = np.intersect1d(ids, other.ids)
    if not len(ids):
        return Corners(ids, np.zeros((0, 2))), 0.0
    places = np.stack([d.px[[int(np.flatnonzero(d.ids == i)[0]) for i in ids]] for d in detections])
    mean = places.mean(axis=0)
    return Corners(ids, mean), float(np.linalg.norm(places - mean, axis=2).max())


def draw(color: Bytes, detection: Detection) -> Bytes:
    """A copy of an (H, W, 3) RGB image with the corners marked; red where the image is refused."""
    picture: Bytes = color.copy()
    mark = (220, 40, 40) if detection.refused else (40, 200, 60)
    for corner, (u, v) in zip(detection.corners.ids, detection.corners.px, strict=True):
        center = (round(u), round(v))
        cv2.circle(picture, center, 5, mark, 1, cv2.LINE_AA)
        cv2.putText(picture, str(corner), (center[0] + 6, center[1] - 4), cv2.FONT_HERSHEY_PLAIN, 0.8, mark, 1)
    return picture
