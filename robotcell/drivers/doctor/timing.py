"""Words for how long answers took."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence


def milliseconds(took_s: Sequence[float]) -> str:
    """Median and 99th percentile of durations [s], in words."""
    return f"{1000 * statistics.median(took_s):.1f} ms (99 %: {1000 * float(np.percentile(took_s, 99)):.1f} ms)"
