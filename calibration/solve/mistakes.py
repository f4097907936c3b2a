"""Mistakes in the making of a set of views, recognised because the set makes sense once the mistake is undone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.consensus import Consensus, find_consensus
from calibration.solve.se3 import difference, invert
from calibration.solve.verdict import Reason, Verdict, refuse

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from robotcell.geometry.transforms import Array

# The other reading must leave less than half of the disagreement; a true one leaves a fiftieth.
_MUCH_BETTER = 0.5
# Of the views that do not fit, this share must fit their neighbour's arm pose.
_EXPLAINED = 0.6
_MIN_EXPLAINED = 3
_FITS = 4.0
# Longer than any arm and any view of a board.
_FAR_M = 20.0


def find_mistake(M: Array, C: Array, on_the_arm: bool, as_given: Consensus) -> Verdict | None:
    """The reading of the views that makes much more sense than the one given.

    Args:
        M: T_parent_child (V, 4, 4).
        C: T_camera_board (V, 4, 4).
        on_the_arm: the arm carries the board, not the camera.
        as_given: what the views agree on as they are, with the scale free.
    """
    if max(_size(M), _size(C)) > _FAR_M:
        return refuse(
            Reason.WRONG_UNITS, f"positions of {max(_size(M), _size(C)):.0f} m: they are in millimetres, not in metres"
        )
    arm_transposed = _transposed(M) if on_the_arm else invert(_transposed(invert(M)))
    readings = (
        (Reason.WRONG_MOUNT, "they fit a camera at the other end: on the flange, or fixed instead", invert(M), C),
        (Reason.INVERTED_POSES, "they fit when the camera's poses are inverted", M, invert(C)),
        (Reason.INVERTED_POSES, "they fit when the camera's and the arm's poses are inverted", invert(M), invert(C)),
        (Reason.TRANSPOSED_POSES, "they fit when the camera's rotations are transposed", M, _transposed(C)),
        (Reason.TRANSPOSED_POSES, "they fit when the arm's rotations are transposed", arm_transposed, C),
        (Reason.SHIFTED_PAIRING, "each image fits the arm pose of the view before it", M[:-1], C[1:]),
        (Reason.SHIFTED_PAIRING, "each image fits the arm pose of the view after it", M[1:], C[:-1]),
    )
    scores = [find_consensus(arm, camera, free_scale=True).score for _, _, arm, camera in readings]
    best = int(np.argmin(scores))
    if scores[best] >= _MUCH_BETTER * as_given.score:
        return None
    reason, words, _, _ = readings[best]
    return refuse(reason, f"the views contradict each other as given; {words}")


def find_partial_shift(
    M: Array, C: Array, X: Array, Z: Array, used: npt.NDArray[np.bool_], names: Sequence[str], lever_m: float
) -> Verdict | None:
    """Views that do not fit, but would with the arm pose of the view before or after.

    Args:
        M: T_parent_child (V, 4, 4).
        C: T_camera_board (V, 4, 4).
        X: T_parent_camera (4, 4).
        Z: T_child_board (4, 4).
        used: (V,) which views fit.
        names: of the views.
        lever_m: distance at which a turn counts.
    """

    def disagreement(indices: npt.NDArray[np.intp], shift: int) -> Array:
        e = difference(C[indices], invert(X) @ M[indices + shift] @ Z)
        return np.asarray(np.linalg.norm(e[:, :3], axis=1) + lever_m * np.linalg.norm(e[:, 3:], axis=1))

    usual = np.median(disagreement(np.flatnonzero(used), 0))
    for shift, where in ((-1, "before"), (1, "after")):
        odd = np.flatnonzero(~used)
        odd = odd[(odd + shift >= 0) & (odd + shift < len(M))]
        if len(odd) < _MIN_EXPLAINED:
            continue
        explained = odd[disagreement(odd, shift) < _FITS * usual]
        if len(explained) >= max(_MIN_EXPLAINED, _EXPLAINED * len(odd)):
            return refuse(
                Reason.SHIFTED_PAIRING,
                f"{len(explained)} images from {names[explained[0]]} on fit the arm pose of the view {where} them",
            )
    return None


def _size(T: Array) -> float:
    return float(np.median(np.linalg.norm(T[:, :3, 3], axis=1)))


def _transposed(T: Array) -> Array:
    transposed: Array = T.copy()
    transposed[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    return transposed
