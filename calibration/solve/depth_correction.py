"""Scale and offset of the depth image, from the board's plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

MIN_SAMPLES = 50
# A D415's depth error grows with the square of the distance (docs/explanation/twin-camera.md).
_HUBER = 2.0
_ITERATIONS = 20
# What is known before: a scale within 2 % and an offset within 10 mm (librealsense issues 3210 and 8075 report 1 % and
# 10 mm). They keep scale and offset apart where all samples lie at one distance.
_PRIOR_SCALE, _PRIOR_OFFSET_M = 0.02, 0.01


@dataclass(frozen=True)
class DepthFit:
    """True depth = scale * measured depth + offset_m.

    Attributes:
        scale: factor.
        offset_m: offset.
        scale_sigma: standard deviation of the scale.
        offset_sigma_m: of the offset.
        rms_before_m: of the depth image against the board's plane as it is.
        rms_after_m: after the correction.
        samples: how many depth pixels.
    """

    scale: float
    offset_m: float
    scale_sigma: float
    offset_sigma_m: float
    rms_before_m: float
    rms_after_m: float
    samples: int


def fit_depth(measured_m: Array, true_m: Array) -> DepthFit | None:
    """Robust straight line through depth samples; None for fewer than 50.

    Args:
        measured_m: (N,) of the depth image; 0 = no return, left out.
        true_m: (N,) of the board's plane along the optical axis.
    """
    returned = (measured_m > 0) & np.isfinite(measured_m)
    measured, true = measured_m[returned], true_m[returned]
    if len(measured) < MIN_SAMPLES:
        return None
    noise_shape = measured**2
    rows = np.column_stack([measured, np.ones_like(measured)])
    prior = np.diag([1 / _PRIOR_SCALE**2, 1 / _PRIOR_OFFSET_M**2])
    unknowns = np.array([1.0, 0.0])
    for _ in range(_ITERATIONS):
        residual = (true - rows @ unknowns) / noise_shape
        sigma = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 1e-9)
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(residual), 1e-12)) / (sigma * noise_shape) ** 2
        information = rows.T @ (weight[:, None] * rows) + prior
        unknowns = np.linalg.solve(information, rows.T @ (weight * true) + prior @ (1.0, 0.0))
    covariance = np.linalg.inv(information)
    return DepthFit(
        scale=float(unknowns[0]),
        offset_m=float(unknowns[1]),
        scale_sigma=float(np.sqrt(covariance[0, 0])),
        offset_sigma_m=float(np.sqrt(covariance[1, 1])),
        rms_before_m=_robust_rms(true - measured),
        rms_after_m=_robust_rms(true - rows @ unknowns),
        samples=len(measured),
    )


def _robust_rms(residual: Array) -> float:
    """Root mean square as of normal numbers with the same median size: a hole's edge does not count."""
    return float(1.4826 * np.median(np.abs(residual)))
