from __future__ import annotations

from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from calibration.solve.pipeline import solve_series
from calibration.solve.readers.pose_csv import read_series
from calibration.solve.se3 import change, difference, exp, invert
from calibration.solve.time_alignment import align
from calibration.solve.time_series import Series
from calibration.solve.verdict import Reason
from robotcell.errors import CalibrationError, ConfigError
from robotcell.geometry.transforms import look_at, make_transform

if TYPE_CHECKING:
    from pathlib import Path

NOW = datetime(2026, 3, 1, tzinfo=timezone.utc)
X = {
    "fixed": look_at((-0.8, 0, 0.8), (-0.5, 0, 0)),
    "flange": make_transform(exp(np.array([0.1, 0.2, 0.3])), (0.05, 0, 0.06)),
}
Z = {
    "fixed": make_transform(exp(np.array([0.3, 0, 1.0])), (0, 0.1, 0.05)),
    "flange": make_transform(np.eye(3), (-0.5, 0.1, 0)),
}


def recording(mount: str, offset: float, *, stops: bool = False, seed: int = 0, seconds: float = 60.0):
    """Flange at 125 Hz and board at 30 Hz of one motion; the board's clock is ahead by the offset."""
    rng = np.random.default_rng(seed)
    knots = np.arange(0, seconds + 2, 2.0)
    base = make_transform(np.diag([1.0, -1.0, -1.0]), (-0.5, 0.0, 0.4))
    targets = np.concatenate([rng.uniform(-0.15, 0.15, (len(knots), 3)), rng.uniform(-0.5, 0.5, (len(knots), 3))], 1)
    spline = CubicSpline(knots, targets)

    def flange(t: np.ndarray) -> np.ndarray:
        # With stops: half of every two seconds at rest.
        s = 2.0 * np.floor(t / 2.0) + np.clip(2.0 * (t % 2.0), 0, 2.0) if stops else t
        return change(np.tile(base, (len(t), 1, 1)), spline(s))

    t_flange = np.arange(0.5, seconds - 0.5, 0.008)
    t_board = np.arange(1.0, seconds - 1.0, 1 / 30) + rng.uniform(0, 0.002)
    M = flange(t_board) if mount == "fixed" else invert(flange(t_board))
    noise = rng.normal(0, 1, (len(t_board), 6)) * (0.0003, 0.0003, 0.001, 0.001, 0.001, 0.0003)
    seen = change(invert(X[mount]) @ M @ Z[mount], noise)
    return Series(t_flange, flange(t_flange)), Series(t_board + offset, seen)


def write(path: Path, series: Series, header: str = "t,x,y,z,qx,qy,qz,qw\n") -> Path:
    q = Rotation.from_matrix(series.T[:, :3, :3]).as_quat()
    rows = np.column_stack([series.t, series.T[:, :3, 3], q])
    path.write_text(header + "".join(",".join(f"{value:.9f}" for value in row) + "\n" for row in rows))
    return path


@pytest.mark.parametrize(
    ("mount", "offset", "stops"), [("flange", 0.05, False), ("fixed", -0.037, True), ("fixed", 1234.5678, False)]
)
def test_offset_and_camera_are_found(mount: str, offset: float, stops: bool) -> None:
    solution = solve_series(*recording(mount, offset, stops=stops), mount)
    assert solution.accepted, solution.verdict.words
    assert solution.views.time_offset_s == pytest.approx(offset, abs=0.001)
    e = difference(solution.estimate.X, X[mount])
    assert np.linalg.norm(e[:3]) < 0.001
    assert np.rad2deg(np.linalg.norm(e[3:])) < 0.1
    assert solution.as_json()["time_offset_s"] == solution.views.time_offset_s


def test_poses_of_the_board_at_standstill_alone_are_enough() -> None:
    flange, board = recording("fixed", 3.21, stops=True)
    # The last half of every two seconds is at rest, a few pictures each.
    resting = (board.t - 3.21) % 2.0 > 1.2
    chosen = np.flatnonzero(resting)[::4]
    solution = solve_series(flange, Series(board.t[chosen], board.T[chosen]), "fixed")
    assert solution.accepted, solution.verdict.words
    assert np.linalg.norm(difference(solution.estimate.X, X["fixed"])[:3]) < 0.001


def test_series_of_different_motions_are_refused() -> None:
    flange, _ = recording("fixed", 0.0, seed=1)
    _, board = recording("fixed", 0.0, seed=2)
    solution = solve_series(flange, board, "fixed")
    assert solution.verdict.reason is Reason.CLOCKS
    assert solution.as_json()["time_offset_s"] is None


def test_a_motion_that_repeats_itself_leaves_the_offset_open() -> None:
    flange, board = recording("fixed", 0.0, seconds=20.0)
    period = 20.0
    twice = Series(np.concatenate([flange.t, flange.t + period]), np.concatenate([flange.T, flange.T]))
    with pytest.raises(CalibrationError, match="repeats"):
        align(twice, board, "fixed", NOW)


def test_a_gap_in_which_the_flange_moved_is_not_bridged() -> None:
    flange, board = recording("fixed", 0.0)
    keep = (flange.t < 20) | (flange.t > 25)
    views = align(Series(flange.t[keep], flange.T[keep]), board, "fixed", NOW)
    times = np.array([float(name.removeprefix("t=")) for name in views.names])
    assert not ((times > 20.1) & (times < 24.9)).any()


def test_files_are_read_as_written(tmp_path: Path) -> None:
    flange, _ = recording("fixed", 0.0, seconds=4.0)
    for header in ("t,x,y,z,qx,qy,qz,qw\n", "", "# t,x,y,z,qx,qy,qz,qw\n"):
        read = read_series(write(tmp_path / "a.csv", flange, header))
        np.testing.assert_allclose(read.t, flange.t, atol=1e-9)
        np.testing.assert_allclose(read.T, flange.T, atol=1e-8)


def test_columns_may_be_in_another_order(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("qw,qx,qy,qz,t,z,y,x,extra\n" + "".join(f"1,0,0,0,{i},3,2,1,9\n" for i in range(12)))
    read = read_series(path)
    np.testing.assert_array_equal(read.T[5, :3, 3], (1, 2, 3))


ROW = "{},0,0,0,0,0,0,1\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "0 poses; at least 12 are needed"),
        ("t,x,y\n1,2,3\n", "line 1: no column z, qx, qy, qz, qw"),
        ("".join(ROW.format(i) for i in range(12)) + "12,0,0\n", "line 13: 3 columns"),
        ("".join(ROW.format(i) for i in range(12)) + "12,0,0,nan,0,0,0,1\n", "line 13: z: 'nan' is not a number"),
        ("".join(ROW.format(i) for i in range(12)) + "12,0,0,a,0,0,0,1\n", "line 13: z: 'a' is not a number"),
        ("".join(ROW.format(i) for i in (*range(12), 5)), "line 13: t does not grow"),
        ("".join(ROW.format(i) for i in range(12)) + "12,0,0,0,0,0,0,3\n", "line 13: qx,qy,qz,qw has length 3.000"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_series(path)
    assert f"{path}: {reason}" in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_series(tmp_path / "a.csv")
