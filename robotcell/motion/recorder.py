"""The last second before a stop: what the arm and the gripper reported, kept as a table and a picture."""

from __future__ import annotations

import csv
import io
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING

import cv2
import numpy as np

from robotcell.geometry.transforms import matrix_to_rotvec
from robotcell.io.atomic_file import make_folder, write_whole
from robotcell.io.images import write_image

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import numpy.typing as npt

    from robotcell.interfaces import ArmState

_KEPT_S = 1.0
# More samples than a second has, and those of the braking after it.
_SAMPLES = 400
_COLUMNS = (
    "t_s",
    *(f"q{i}_rad" for i in range(1, 7)),
    *(f"qd{i}_rad_s" for i in range(1, 7)),
    *("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"),
    *("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"),
    "width_m",
    "mode",
)
_FORCE_COLUMNS, _SPEED_COLUMNS = slice(19, 22), slice(7, 13)
_WIDTH_PX, _PANEL_PX, _MARGIN_PX = 720, 170, 46
_WHITE, _GREY, _BLACK, _RED = (255, 255, 255), (210, 210, 210), (40, 40, 40), (200, 40, 30)
_LINES = ((31, 119, 180), (255, 127, 14), (44, 160, 44), (148, 103, 189), (140, 86, 75), (23, 190, 207))


@dataclass
class Recorder:
    """Where the states before a stop are written to.

    Attributes:
        folder: of the files, which is made when there is one to write; None: `stops` in the folder of the runs.
    """

    folder: Path | None = None

    @contextmanager
    def into(self, folder: Path) -> Iterator[None]:
        """Write to another folder, that of a run, as long as this lasts."""
        before, self.folder = self.folder, folder
        try:
            yield
        finally:
            self.folder = before


@dataclass
class StateLog:
    """What was reported while a plan ran; the newest samples are kept."""

    _samples: deque[tuple[ArmState, float]] = field(default_factory=lambda: deque(maxlen=_SAMPLES))

    def add(self, state: ArmState, width_m: float) -> None:
        """Keep a measurement; the width of the fingers is NaN where they were not asked."""
        self._samples.append((state, width_m))

    def save(self, folder: Path, label: str, reason: str, stopped_at: float) -> Path | None:
        """Write `stop-<time>-<label>.csv` and the picture of it beside it; None where nothing was measured.

        Args:
            folder: of the files.
            label: of what was stopped.
            reason: why, for the picture.
            stopped_at: when, on the cell's clock [s]; time 0 of the files. What comes later is the braking.

        Raises:
            StorageError: they cannot be written.
        """
        samples = [(state, width) for state, width in self._samples if state.t >= stopped_at - _KEPT_S]
        if not samples:
            return None
        values = np.array([_numbers(state, width, stopped_at) for state, width in samples])
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(_COLUMNS)
        table.writerows([*row, state.mode.value] for row, (state, _) in zip(values.round(5), samples, strict=True))
        make_folder(folder)
        path = folder / f"stop-{datetime.now():%Y%m%d-%H%M%S-%f}-{label}.csv"
        write_whole(path, text.getvalue())
        write_image(path.with_suffix(".png"), _draw(values, reason))
        return path


def _numbers(state: ArmState, width_m: float, stopped_at: float) -> npt.NDArray[np.float64]:
    """The columns of a measurement but for its mode."""
    T = state.T_base_tcp
    pose = (*T[:3, 3], *matrix_to_rotvec(T[:3, :3]))
    return np.array([state.t - stopped_at, *state.q, *state.qd, *pose, *state.wrench, width_m])


def _draw(rows: npt.NDArray[np.float64], reason: str) -> npt.NDArray[np.uint8]:
    """Force on the tool and the speeds of the joints over time, as an RGB image."""
    t = rows[:, 0]
    force = np.linalg.norm(rows[:, _FORCE_COLUMNS], axis=1)
    page = np.full((2 * _PANEL_PX + _MARGIN_PX, _WIDTH_PX, 3), _WHITE, np.uint8)
    cv2.putText(page, reason[:100], (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _BLACK, 1, cv2.LINE_AA)
    _panel(page[30 : 30 + _PANEL_PX], t, force[:, None], "force on the tool [N]")
    _panel(page[30 + _PANEL_PX : 30 + 2 * _PANEL_PX], t, rows[:, _SPEED_COLUMNS], "joint speeds [rad/s], 1 blue to 6")
    return page


def _panel(
    panel: npt.NDArray[np.uint8], t: npt.NDArray[np.float64], values: npt.NDArray[np.float64], title: str
) -> None:
    """Draw curves (N, K) over times (N,) [s] into a part of the page; a red line marks time 0."""
    values = np.nan_to_num(values)
    low, high = min(0.0, float(values.min())), max(float(values.max()), 1e-3)
    left, right, top, bottom = _MARGIN_PX, _WIDTH_PX - 10, 18, _PANEL_PX - 14
    span = max(float(t[-1] - t[0]), 1e-3)
    u = left + (t - t[0]) / span * (right - left)
    for value in (low, high):
        y = round(bottom - (value - low) / (high - low) * (bottom - top))
        cv2.line(panel, (left, y), (right, y), _GREY, 1)
        cv2.putText(panel, f"{value:.3g}", (4, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _BLACK, 1, cv2.LINE_AA)
    stop = round(left + (0.0 - t[0]) / span * (right - left))
    cv2.line(panel, (stop, top), (stop, bottom), _RED, 1)
    for k in range(values.shape[1]):
        v = bottom - (values[:, k] - low) / (high - low) * (bottom - top)
        points = np.round(np.stack([u, v], axis=1)).astype(np.int32)
        cv2.polylines(panel, [points], False, _LINES[k % len(_LINES)], 1, cv2.LINE_AA)
    cv2.putText(panel, title, (left, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _BLACK, 1, cv2.LINE_AA)
