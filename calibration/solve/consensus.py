"""The solution that most views agree on, whatever the others say.

Least trimmed squares (Rousseeuw and Van Driessen 2006): small random subsets are solved in closed form, the solution
under which the better half of the views disagrees least is kept, and then re-solved from the views that fit it. Nearly
half of the views may be wrong without any effect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.solve.closed_form import shah_rotations, translations
from robotcell.geometry.transforms import Array, make_transform

# Four views leave no freedom that noise could fill; of 150 draws from views of which 40 % are wrong, 19 are clean.
_SUBSET = 4
_SUBSETS = 150
_CONCENTRATIONS = 8
_SHARE = 0.6
# A turn counts as the distance that it moves a point this share of the way between camera and board.
LEVER = 0.4


@dataclass(frozen=True)
class Consensus:
    """What most views agree on.

    Attributes:
        X: T_parent_camera (4, 4).
        Z: T_child_board (4, 4).
        scale: factor on the camera's translations; 1 unless it was left free.
        disagreement: (V,) of each view [m]: distance, and turn times a lever, together.
    """

    X: Array
    Z: Array
    scale: float
    disagreement: Array

    @property
    def score(self) -> float:
        """Disagreement [m] of the median view."""
        return float(np.median(self.disagreement))


def find_consensus(M: Array, C: Array, *, free_scale: bool = False) -> Consensus:
    """Solve M_i Z = X C_i so that most views agree.

    Args:
        M: T_parent_child (V, 4, 4), at least four.
        C: T_camera_board (V, 4, 4).
        free_scale: the camera's translations are true up to a common factor.
    """
    rng = np.random.default_rng(0)
    count = len(M)
    subsets = np.argsort(rng.random((_SUBSETS, count)), axis=1)[:, : min(_SUBSET, count)]
    solution = _solve(M, C, subsets, free_scale)
    disagreement = _disagreement(M, C, *solution)
    best = int(np.argmin(np.median(disagreement, axis=1)))
    X, Z, scale, rest = solution[0][best], solution[1][best], solution[2][best], disagreement[best]
    for _ in range(_CONCENTRATIONS):
        fitting = np.argsort(rest)[None, : max(_SUBSET, round(_SHARE * count))]
        solution = _solve(M, C, fitting, free_scale)
        candidate = _disagreement(M, C, *solution)[0]
        if np.median(candidate) >= np.median(rest):
            break
        X, Z, scale, rest = solution[0][0], solution[1][0], solution[2][0], candidate
    return Consensus(X, Z, float(scale), rest)


def _solve(M: Array, C: Array, subsets: npt.NDArray[np.intp], free_scale: bool) -> tuple[Array, Array, Array]:
    """X, Z (S, 4, 4) and the scale (S,) of subsets (S, n) of the views."""
    M_s, C_s = M[subsets], C[subsets]
    R_X, R_Z = shah_rotations(M_s[..., :3, :3], C_s[..., :3, :3])
    t_X, t_Z, scale = translations(R_X, M_s, C_s, free_scale=free_scale)
    X = np.stack([make_transform(R, t) for R, t in zip(R_X, t_X, strict=True)])
    Z = np.stack([make_transform(R, t) for R, t in zip(R_Z, t_Z, strict=True)])
    return X, Z, scale


def _disagreement(M: Array, C: Array, X: Array, Z: Array, scale: Array) -> Array:
    """(S, V) [m] of the views under S solutions."""
    carried = np.einsum("vij,sj->svi", M[:, :3, :3], Z[:, :3, 3]) + M[None, :, :3, 3]
    seen = np.einsum("sij,vj->svi", X[:, :3, :3], C[:, :3, 3]) * scale[:, None, None] + X[:, None, :3, 3]
    # |R - 1|_F^2 = 4 (1 - cos angle), close to twice the angle squared.
    turned = np.einsum("vij,sjk->svik", M[:, :3, :3], Z[:, :3, :3]) - np.einsum(
        "sij,vjk->svik", X[:, :3, :3], C[:, :3, :3]
    )
    lever = LEVER * np.median(np.linalg.norm(C[:, :3, 3], axis=1)) * np.abs(scale)[:, None]
    squared = ((carried - seen) ** 2).sum(-1) + lever**2 * 0.5 * (turned**2).sum((-1, -2))
    return np.asarray(np.sqrt(squared))
