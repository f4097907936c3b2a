"""Weights that hold back what is too far off to be noise (Huber 1964)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

# 95 % of good views keep their full weight; the pull of the others no longer grows with their error (Huber 1964).
HUBER = float(np.sqrt(chi2.ppf(0.95, 6)))
# A good view is called an outlier once in ten thousand.
OUTLIER = float(np.sqrt(chi2.ppf(1 - 1e-4, 6)))
# A corner further off than this many standard deviations is a false detection and pulls no harder (Huber 1964).
HUBER_CORNER = 2.5


def huber_weights(distance: Array) -> Array:
    """Huber weights (V,) of views.

    Args:
        distance: (V,) disagreement in standard deviations (Mahalanobis, six degrees of freedom).
    """
    return np.asarray(np.minimum(1.0, HUBER / np.maximum(distance, 1e-12)))


def corner_weights(residual_px: Array, seen: Array, sigma_px: float) -> Array:
    """Huber weights (V, K) of corners, 0 for padding.

    Args:
        residual_px: (V, K, 2).
        seen: (V, K).
        sigma_px: standard deviation of a coordinate.
    """
    size = np.linalg.norm(residual_px, axis=-1) / sigma_px
    return np.asarray(seen * np.minimum(1.0, HUBER_CORNER / np.maximum(size, 1e-12)))
