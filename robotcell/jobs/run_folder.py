"""The folder of a run: its name, and the images of the frames that decisions were made on."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import StorageError
from robotcell.interfaces import RgbdFrame
from robotcell.io.images import read_image, write_image

if TYPE_CHECKING:
    from robotcell.jobs.journal_tables import Frame

# Finer than the unit of the camera, and 16 bits reach 6.5 m.
_DEPTH_UNIT_M = 1e-4


def make_run_dir(runs: Path, label: str) -> Path:
    """A new folder runs/<time>-<label>, numbered where the second does not tell two runs apart.

    Raises:
        StorageError: it cannot be made.
    """
    stem = f"{datetime.now():%Y%m%d-%H%M%S}-{label}"
    for suffix in ("", *(f"-{n}" for n in range(2, 100))):
        path = runs / f"{stem}{suffix}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise StorageError(f"journal.runs = {str(runs)!r}: {path} cannot be made: {error.strerror}") from error
        return path
    raise StorageError(f"journal.runs = {str(runs)!r}: there are a hundred runs called {stem}")


def save_frame(frame: RgbdFrame, run_dir: Path) -> tuple[Path, Path]:
    """Write the images of a frame, colour as it is and depth in 1/10 mm; returns the two files.

    Raises:
        StorageError: they cannot be written.
    """
    folder = run_dir / "frames"
    color_file, depth_file = (folder / f"{frame.number:06d}-{kind}.png" for kind in ("color", "depth"))
    depth = np.clip(np.round(frame.depth_m / _DEPTH_UNIT_M), 0, 65535).astype(np.uint16)
    for path, image in ((color_file, frame.color), (depth_file, depth)):
        write_image(path, image, compression=1)
    return color_file, depth_file


def load_frame(row: Frame, like: RgbdFrame) -> RgbdFrame | None:
    """A frame of an earlier look; None if its images are gone, or are of another mode of the camera.

    Args:
        row: of the frame.
        like: a frame of the same camera; it has the intrinsics.
    """
    color, depth = read_image(Path(row.color_file)), read_image(Path(row.depth_file))
    if color is None or depth is None or color.shape != like.color.shape or depth.shape != like.depth_m.shape:
        return None
    depth_m = (depth * _DEPTH_UNIT_M).astype(np.float32)
    return RgbdFrame(row.t, row.number, color.astype(np.uint8), depth_m, like.intrinsics, like.serial)
