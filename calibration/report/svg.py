"""Drawing in SVG that takes its colours from the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

_STEPS = (1.0, 2.0, 5.0)


def drawing(width: float, height: float, parts: Iterable[str], label: str) -> str:
    """A drawing of so many units."""
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg>'


def line(a: tuple[float, float], b: tuple[float, float], style: str) -> str:
    """A line from one point to another."""
    return f'<line class="{style}" x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"/>'


def text(place: tuple[float, float], words: str, anchor: str) -> str:
    """Words at a point."""
    return f'<text x="{place[0]:.1f}" y="{place[1]:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def escape(words: str) -> str:
    """Words without what SVG would read as marks."""
    return words.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")


def interpolate(value: float, low: float, high: float, start: float, end: float) -> float:
    """Where a value stands on an axis that runs from `start` (at `low`) to `end` (at `high`)."""
    return float(start + (value - low) / (high - low) * (end - start))


def round_step(span: float, count: int) -> float:
    """1, 2 or 5 times a power of ten: about `count` of them make up `span`."""
    power = 10 ** np.floor(np.log10(span / count))
    return float(max(m * power for m in _STEPS if m * power <= span / count * 1.001))
