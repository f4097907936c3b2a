"""The noise of views as a sum of covariance components, whose variances are estimated from the data.

The covariance of a view's disagreement is a sum of known shapes with unknown factors: errors of the arm's position and
rotation, of the corners, or of the board's pose in each direction. Restricted maximum likelihood finds the factors
together with the hand-eye transforms, so the weight of a millimetre against a degree follows from the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.se3 import difference, skew

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

# Standard deviations are not estimated below a micrometre and a microradian: nothing mechanical is.
FLOOR = 1e-6


@dataclass(frozen=True)
class Noise:
    """What the covariance of a view's disagreement is made of.

    Attributes:
        shapes: (K, V, 6, 6); the covariance of view i is the sum over k of variance k times shape (k, i).
        floors: (K,) smallest variances.
    """

    shapes: Array
    floors: Array


def pose_noise(C: Array) -> Noise:
    """Noise of poses that come without corners: across the view, along it, and turns about the same axes.

    A board's distance and tilt are seen several times worse than its place in the image and its turn about the axis.
    """
    shapes = np.zeros((4, len(C), 6, 6))
    for k, axes in enumerate(((0, 1), (2,), (3, 4), (5,))):
        for axis in axes:
            shapes[k, :, axis, axis] = 1.0
    return Noise(shapes, np.full(4, FLOOR**2))


def arm_noise(X: Array, M: Array, C: Array, *, on_the_arm: bool) -> Array:
    """Shapes (2, V, 6, 6) of an error of the flange's position and of its rotation, alike in all directions.

    Args:
        X: T_parent_camera (4, 4).
        M: T_parent_child (V, 4, 4).
        C: T_camera_board (V, 4, 4).
        on_the_arm: the arm carries the board (the flange is the child), not the camera.
    """
    flange = (M[:, :3, 3] if on_the_arm else np.zeros((len(M), 3))) - X[:3, 3]
    lever = C[:, :3, 3] - flange @ X[:3, :3]
    moved = np.concatenate([-skew(lever), np.broadcast_to(np.eye(3), (len(M), 3, 3))], axis=1)
    shapes = np.zeros((2, len(M), 6, 6))
    shapes[0, :, :3, :3] = np.eye(3)
    shapes[1] = moved @ np.swapaxes(moved, -1, -2)
    return shapes


def first_variances(C_predicted: Array, C: Array, noise: Noise, used: npt.NDArray[np.bool_]) -> Array:
    """A start: each component alone explains the median disagreement in the directions that it acts in."""
    e = difference(C, C_predicted)
    shapes = noise.shapes[:, used]
    trace = np.einsum("kvij,kvji->kv", shapes, shapes).mean(axis=1)
    sizes = np.median(np.einsum("vi,kvij,vj->kv", e[used], shapes, e[used]), axis=1)
    return np.asarray(sizes / trace)


def next_variances(variances: Array, e: Array, J: Array, W: Array, A: Array, weight: Array, noise: Noise) -> Array:
    """One step of the fixed point of restricted maximum likelihood (Harville 1977): e'PGPe / trace(PG) tends to one."""
    We = (W @ e[..., None])[..., 0]
    quadratic = np.einsum("v,vi,kvij,vj->k", weight, We, noise.shapes, We)
    taking_part = (weight > 0).astype(np.float64)
    WJ = W @ J
    lost = (noise.shapes @ WJ) * (weight[:, None, None] * WJ @ np.linalg.pinv(A, hermitian=True))
    trace = ((noise.shapes * W).sum(axis=(2, 3)) * taking_part).sum(axis=1) - lost.sum(axis=(1, 2, 3))
    return np.asarray(variances * quadratic / np.maximum(trace, 1e-12))
