"""How sure a weighted least-squares result is whose weights are estimates themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array


def kenward_roger(J: Array, W: Array, weight: Array, shapes: Array) -> tuple[Array, Array]:
    """Covariance (p, p), and the part of it that is due to estimated variances (Kenward and Roger 1997).

    Args:
        J: (V, 6, p) Jacobian.
        W: (V, 6, 6) inverse covariance of each view's disagreement.
        weight: (V,) of each view.
        shapes: (K, V, 6, 6) of the noise.
    """
    WJ = weight[:, None, None] * (W @ J)
    weighted = weight[:, None, None] * W
    simple = np.linalg.pinv(np.tensordot(J, WJ, axes=([0, 1], [0, 1])), hermitian=True)
    GWJ, GW = shapes @ WJ, shapes @ weighted
    P = np.tensordot(WJ, GWJ, axes=([0, 1], [1, 2])).transpose(1, 0, 2)
    Q = np.tensordot(GWJ, weighted @ GWJ, axes=([1, 2], [1, 2])).transpose(0, 2, 1, 3)
    PP = P[:, None] @ simple @ P[None]
    fisher = np.einsum("kvij,lvji->kl", GW, GW) - 2 * (Q * simple).sum(axis=(2, 3)) + (PP * simple).sum(axis=(2, 3))
    spread = 2 * np.linalg.pinv(fisher, hermitian=True)
    extra = 2 * simple @ np.tensordot(spread, Q - PP, axes=2) @ simple
    return np.asarray(simple + extra), np.asarray(extra)
