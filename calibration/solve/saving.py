"""The calibration file: written unless a better one stands there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.calibration_file import CameraCalibration, FixedTag, load_calibration, save_calibration
from robotcell.errors import CalibrationError

if TYPE_CHECKING:
    from pathlib import Path

    from calibration.solve.solution import Solution

# Two results whose standard deviations differ by less than a tenth are as good as each other.
_CLEARLY = 6 * 2 * float(np.log(1.1))


def save_if_better(solution: Solution, path: Path, tags: tuple[FixedTag, ...] = ()) -> None:
    """Write the calibration file, unless a better and equally fresh one of the same camera stands there.

    Better is a smaller uncertainty (the volume of the covariance): it falls with more and with quieter views. A file
    of another camera, mount or resolution, or one that is older than half a year, is never better.

    Args:
        solution: to write.
        path: of the file.
        tags: fixed tags that were in view.

    Raises:
        CalibrationError: the result was refused, or what stands there is better.
        ConfigError: what stands there is no calibration.
        StorageError: the file cannot be written.
    """
    calibration = solution.calibration().model_copy(update={"tags": tags})
    if path.exists():
        before = load_calibration(path)
        if _comparable(before, calibration) and _log_volume(before) < _log_volume(calibration) - _CLEARLY:
            raise CalibrationError(
                f"{path} of {before.date:%Y-%m-%d} is better ({before.views} views, held-out median "
                f"{before.held_out.mm.median:.2f} mm) and was kept; give another --out, or move that file away if the "
                "camera was moved since"
            )
    save_calibration(calibration, path)


def _comparable(before: CameraCalibration, new: CameraCalibration) -> bool:
    size = (new.camera.width, new.camera.height)
    if before.mount != new.mount or (before.camera.width, before.camera.height) != size:
        return False
    try:
        before.check(serial=new.camera.serial, now=max(new.date, before.date))
    except CalibrationError:
        return False
    return True


def _log_volume(calibration: CameraCalibration) -> float:
    return float(np.linalg.slogdet(np.array(calibration.covariance))[1])
