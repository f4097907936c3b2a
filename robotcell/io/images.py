"""Writing images, and reading them again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2

from robotcell.errors import StorageError
from robotcell.io.atomic_file import make_folder

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt


def write_image(path: Path, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], compression: int = 3) -> None:
    """Write a PNG; its folder is made.

    Args:
        path: of the file.
        image: (H, W, 3) uint8 RGB, or (H, W) of one channel.
        compression: 0 to 9; more takes longer.

    Raises:
        StorageError: it cannot be written.
    """
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    written, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, compression])
    if not written:
        raise StorageError(f"{path}: an image of shape {image.shape} cannot be written as PNG")
    make_folder(path.parent)
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror}; check the folder and the disk") from error


def read_image(path: Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | None:
    """Read a PNG that `write_image` has written: (H, W, 3) uint8 RGB or (H, W); None if it is gone or no image."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if pixels is None:
        return None
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels  # type: ignore[return-value]
