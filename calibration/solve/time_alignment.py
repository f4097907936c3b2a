"""The offset between the clocks of two time series: poses of the flange, and of the board as the camera saw it.

Both turn by the same angle over the same interval, wherever camera and board are mounted. So the offset between the
clocks is first where these angles agree best, and is then refined together with the hand-eye transforms.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.solve.consensus import find_consensus
from calibration.solve.handeye import predict
from calibration.solve.se3 import change, difference, invert
from calibration.solve.time_series import Series
from calibration.solve.views import Views
from robotcell.errors import CalibrationError

if TYPE_CHECKING:
    from datetime import datetime

    from robotcell.config.calibration_file import Mount
    from robotcell.geometry.transforms import Array

# The first search: so many intervals of about so long, on a grid of so many offsets at most.
_INTERVALS = 200
_INTERVAL_S = 0.5
_OFFSETS = 40000
_MIN_STEP_S = 0.005
# Half of the shorter series must lie inside the other.
_MIN_OVERLAP = 0.5
# Shares of the turning that may disagree, and of what the next best offset (this far away) leaves.
_MAX_DISAGREEMENT = 0.35
_DISTINCT = 0.8
_APART_S = 1.0
# Views nearer to each other than this say the same thing; more views than this only take time.
_SAME_M, _SAME_RAD = 0.005, float(np.deg2rad(1.0))
_MAX_VIEWS = 200
# The flange's pose is not interpolated across a longer gap in which it moved.
_MAX_GAPS = 3.0


def align(flange: Series, board: Series, mount: Mount, date: datetime) -> Views:
    """Find the offset between the clocks, and pair each pose of the board with the flange's at that instant.

    Args:
        flange: T_base_flange.
        board: T_camera_board, by another clock.
        mount: where the camera is.
        date: of the recording.

    Raises:
        CalibrationError: no offset makes the two turn alike, or several do.
    """
    offset, step = _coarse_offset(flange, board)
    chosen = _distinct(_covered(flange, board, offset), flange, offset)
    offset = _refine_offset(flange, chosen, offset, step, mount)
    chosen = _distinct(_covered(flange, board, offset), flange, offset)
    return Views(
        mount=mount,
        names=tuple(f"t={t:.3f}" for t in chosen.t),
        T_base_flange=flange.at(chosen.t - offset),
        date=date,
        T_camera_board=chosen.T,
        time_offset_s=offset,
    )


def _coarse_offset(flange: Series, board: Series) -> tuple[float, float]:
    """Offset (board's clock minus flange's) where the turns agree best, and the grid's step [s]."""
    stride = max(1, round(_INTERVAL_S / float(np.median(np.diff(board.t)))))
    starts = np.unique(np.linspace(0, len(board.t) - 1 - stride, _INTERVALS).astype(int))
    turned = _angles(_quaternions(board.T[starts]), _quaternions(board.T[starts + stride]))
    overlap = _MIN_OVERLAP * min(board.t[-1] - board.t[0], flange.t[-1] - flange.t[0])
    first, last = board.t[0] - flange.t[-1] + overlap, board.t[-1] - flange.t[0] - overlap
    step = max(_MIN_STEP_S, (last - first) / _OFFSETS)
    offsets = np.arange(first, last + step, step)
    grid = np.arange(flange.t[0], flange.t[-1] + step, step)
    q = _quaternions(flange.at(grid))
    disagreement = np.concatenate(
        [
            _disagreement(part, q, grid[0], step, board.t[starts], board.t[starts + stride], turned)
            for part in np.array_split(offsets, max(1, len(offsets) // 1000))
        ]
    )
    best = int(np.argmin(disagreement))
    apart = np.abs(offsets - offsets[best]) > _APART_S
    if disagreement[best] > _MAX_DISAGREEMENT:
        raise CalibrationError(
            "at no offset between the clocks do flange and board turn alike (at best "
            f"{100 * disagreement[best]:.0f} % of the turning disagrees): are both files of the same motion?"
        )
    if apart.any() and disagreement[best] > _DISTINCT * disagreement[apart].min():
        other = offsets[apart][np.argmin(disagreement[apart])]
        raise CalibrationError(
            f"the clocks fit with an offset of {offsets[best]:.2f} s and with one of {other:.2f} s: the motion repeats"
        )
    return float(offsets[best]), step


def _disagreement(
    offsets: Array, q: Array, grid_start: float, step: float, begin: Array, end: Array, turned: Array
) -> Array:
    """Share (N,) of the turning in the board's intervals that the flange does not do, for N offsets."""
    i = np.rint((begin[None, :] - offsets[:, None] - grid_start) / step).astype(int)
    j = np.rint((end[None, :] - offsets[:, None] - grid_start) / step).astype(int)
    inside = (i >= 0) & (j < len(q))
    flange = _angles(q[np.clip(i, 0, len(q) - 1)], q[np.clip(j, 0, len(q) - 1)])
    difference_sum = (np.abs(flange - turned) * inside).sum(axis=1)
    covered = (turned * inside).sum(axis=1)
    total = ((flange + turned) * inside).sum(axis=1)
    return np.where(covered > _MIN_OVERLAP * turned.sum(), difference_sum / np.maximum(total, 1e-9), 1.0)


def _refine_offset(flange: Series, board: Series, offset: float, step: float, mount: Mount) -> float:
    """The offset, refined together with the hand-eye transforms."""

    def carried(delta: float) -> Array:
        T = flange.at(board.t - offset - delta)
        return T if mount == "fixed" else invert(T)

    start = find_consensus(carried(0.0), board.T, free_scale=False)
    lever = np.median(np.linalg.norm(board.T[:, :3, 3], axis=1))
    weights = np.array([1.0, 1.0, 1.0, lever, lever, lever]) / max(start.score, 1e-6)
    reach = 2 * step + 0.1

    def residuals(unknowns: Array) -> Array:
        X, Z = change(start.X, unknowns[:6]), change(start.Z, unknowns[6:12])
        e = difference(board.T, predict(X, Z, carried(unknowns[12])))
        return np.asarray((weights * e).ravel())

    bounds = np.full(13, np.inf)
    bounds[12] = reach
    found = least_squares(residuals, np.zeros(13), loss="huber", x_scale="jac", bounds=(-bounds, bounds), max_nfev=50)
    return offset + float(found.x[12])


def _covered(flange: Series, board: Series, offset: float) -> Series:
    """The board's poses at instants at which the flange's is known: no gap in which it moved."""
    t = board.t - offset
    after = np.clip(np.searchsorted(flange.t, t), 1, len(flange.t) - 1)
    usual = np.median(np.diff(flange.t))
    narrow = flange.t[after] - flange.t[after - 1] <= _MAX_GAPS * usual
    moved = difference(flange.T[after], flange.T[after - 1])
    still = (np.linalg.norm(moved[:, :3], axis=1) < _SAME_M / 10) & (
        np.linalg.norm(moved[:, 3:], axis=1) < _SAME_RAD / 10
    )
    chosen = (t >= flange.t[0]) & (t <= flange.t[-1]) & (narrow | still)
    return Series(board.t[chosen], board.T[chosen])


def _distinct(board: Series, flange: Series, offset: float) -> Series:
    """Poses that differ from the one before, evenly thinned; more would only repeat each other's errors."""
    if not len(board.t):
        raise CalibrationError("the two series do not overlap at any instant")
    T = flange.at(board.t - offset)
    position, q = T[:, :3, 3], _quaternions(T)
    chosen = [0]
    for i in range(1, len(T)):
        last = chosen[-1]
        if np.linalg.norm(position[i] - position[last]) > _SAME_M or _angles(q[i], q[last]) > _SAME_RAD:
            chosen.append(i)
    thinned = np.array(chosen)[np.unique(np.linspace(0, len(chosen) - 1, _MAX_VIEWS).astype(int))]
    return Series(board.t[thinned], board.T[thinned])


def _quaternions(T: Array) -> Array:
    return np.asarray(Rotation.from_matrix(T[..., :3, :3]).as_quat())


def _angles(q_a: Array, q_b: Array) -> Array:
    """Angles (...) [rad] between unit quaternions (..., 4)."""
    return np.asarray(2 * np.arccos(np.clip(np.abs((q_a * q_b).sum(axis=-1)), 0.0, 1.0)))
