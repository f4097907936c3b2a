"""What the doctor finds: the rows of its report."""

from __future__ import annotations

import enum
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence


class Grade(enum.Enum):
    """How good a finding is."""

    OK = "ok"
    NOTE = "note"  # works, and could be better
    WRONG = "wrong"  # a job cannot run, or not safely


@dataclass(frozen=True)
class Finding:
    """One row of the report; `cure` says what to do where the grade is not OK."""

    device: str
    what: str
    value: str
    grade: Grade = Grade.OK
    cure: str = ""


def milliseconds(took_s: Sequence[float]) -> str:
    """Median and 99th percentile of durations [s], in words."""
    return f"{1000 * statistics.median(took_s):.1f} ms (99 %: {1000 * float(np.percentile(took_s, 99)):.1f} ms)"
