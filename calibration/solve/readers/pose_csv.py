"""Poses over time from CSV files. Every mistake names the file, the line and the column."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.solve.time_series import Series
from robotcell.errors import ConfigError
from robotcell.io.input_file import MEASUREMENTS_MAX_BYTES, read_text

if TYPE_CHECKING:
    from pathlib import Path

_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_MIN_ROWS = 12
_QUATERNION_TOLERANCE = 0.02


def read_series(path: Path) -> Series:
    """Read a CSV file with the columns t,x,y,z,qx,qy,qz,qw: seconds, metres, quaternion with its scalar last.

    A first line with the names of the columns is optional and may order them otherwise.

    Raises:
        ConfigError: naming the file, the line and what is wrong.
    """
    lines = read_text(path, MEASUREMENTS_MAX_BYTES).splitlines()
    try:
        rows = [(number, row) for number, row in enumerate(csv.reader(lines), 1) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ConfigError(f"{path}: not a CSV file: {error}") from error
    order = list(range(len(_COLUMNS)))
    if rows and not _is_number(rows[0][1][0]):
        names = [cell.strip().lstrip("#").strip() for cell in rows[0][1]]
        missing = [column for column in _COLUMNS if column not in names]
        if missing:
            raise ConfigError(
                f"{path}: line {rows[0][0]}: no column {', '.join(missing)}; needed: {','.join(_COLUMNS)}"
            )
        order = [names.index(column) for column in _COLUMNS]
        rows = rows[1:]
    values = np.array([_numbers(row, order, f"{path}: line {number}") for number, row in rows]).reshape(-1, 8)
    if len(values) < _MIN_ROWS:
        raise ConfigError(f"{path}: {len(values)} poses; at least {_MIN_ROWS} are needed")
    backwards = np.flatnonzero(np.diff(values[:, 0]) <= 0)
    if len(backwards):
        raise ConfigError(f"{path}: line {rows[backwards[0] + 1][0]}: t does not grow")
    norms = np.linalg.norm(values[:, 4:], axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1) > _QUATERNION_TOLERANCE)
    if len(wrong):
        raise ConfigError(
            f"{path}: line {rows[wrong[0]][0]}: qx,qy,qz,qw has length {norms[wrong[0]]:.3f}; a rotation has 1"
        )
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    T[:, :3, 3] = values[:, 1:4]
    return Series(values[:, 0], T)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(row: list[str], order: list[int], place: str) -> list[float]:
    if len(row) <= max(order):
        raise ConfigError(f"{place}: {len(row)} columns; needed: {','.join(_COLUMNS)}")
    numbers = []
    for column, index in zip(_COLUMNS, order, strict=True):
        if not _is_number(row[index]) or not np.isfinite(float(row[index])):
            raise ConfigError(f"{place}: {column}: {row[index].strip()!r} is not a number")
        numbers.append(float(row[index]))
    return numbers
