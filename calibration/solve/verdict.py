"""Whether a calibration may be used; if not, the reason, in words, and the cure."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.se3 import log

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

MIN_VIEWS = 12
# A result that rests on fewer of its views than this is a choice, not a measurement.
MIN_USED_SHARE = 0.6
# Of the turns between views, about their second strongest axis, rms. The error of X grows with its inverse.
MIN_ROTATION_DEG = 5.0
# A print is seldom truer than half of this; 1 % is 8 mm at 0.8 m.
MAX_SCALE_ERROR = 0.01
_SCALE_SIGMAS = 4.0
# Beyond these factors nobody printed a wrong square: metres and millimetres were mixed up.
_UNIT_FACTORS = (0.05, 20.0)
# Where refining the intrinsics leaves less than this share of the held-out error, those that were given are wrong.
MAX_INTRINSICS_GAIN = 0.7
# Held-out errors of the median view with which nothing can be picked.
MAX_HELD_OUT_MM, MAX_HELD_OUT_DEG = 15.0, 1.5
# One standard deviation of the result, in its worst direction.
MAX_SIGMA_MM, MAX_SIGMA_DEG = 3.0, 0.3


class Reason(str, enum.Enum):
    """Why a calibration is refused."""

    TOO_FEW_VIEWS = "too_few_views"
    TOO_LITTLE_ROTATION = "too_little_rotation"
    MIRRORED = "mirrored"
    INVERTED_POSES = "inverted_poses"
    TRANSPOSED_POSES = "transposed_poses"
    WRONG_MOUNT = "wrong_mount"
    SHIFTED_PAIRING = "shifted_pairing"
    WRONG_UNITS = "wrong_units"
    WRONG_SQUARE_SIZE = "wrong_square_size"
    WRONG_INTRINSICS = "wrong_intrinsics"
    INCONSISTENT = "inconsistent"
    UNCERTAIN = "uncertain"
    CLOCKS = "clocks"


_CURES = {
    Reason.TOO_FEW_VIEWS: f"Take more views; {MIN_VIEWS} usable ones are needed and 20 are recommended.",
    Reason.TOO_LITTLE_ROTATION: "Take more views with the flange tilted by 20 to 40 degrees, about two different axes.",
    Reason.MIRRORED: "Switch off the mirroring of the image; give poses in right-handed axes (camera: x right, y down, "
    "z forward).",
    Reason.INVERTED_POSES: "Give T_camera_board (the board in the camera frame) and T_base_flange, not their inverses.",
    Reason.TRANSPOSED_POSES: "Write matrices row by row, with the position in the last column.",
    Reason.WRONG_MOUNT: "Give the right --mount; or, if it is right, give T_base_flange and not its inverse.",
    Reason.SHIFTED_PAIRING: "Store image and arm pose as one record per view, and drop both where the board was not "
    "found.",
    Reason.WRONG_UNITS: "Give every position in metres.",
    Reason.WRONG_SQUARE_SIZE: "Measure the squares of the printed board and give that size; print at 100 %. If they "
    "are right, the intrinsics are not: try --refine-intrinsics.",
    Reason.WRONG_INTRINSICS: "Give the intrinsics of this camera at this resolution, or let --refine-intrinsics find "
    "them.",
    Reason.INCONSISTENT: "See that board and camera are bolted firmly, that the arm stands still at each view, and "
    "that its poses are those of the flange; then take new views.",
    Reason.UNCERTAIN: "Take more views, spread over the workspace, with larger tilts and different distances.",
    Reason.CLOCKS: "Record both series over the same time, with the flange turning about changing axes.",
}


@dataclass(frozen=True)
class Verdict:
    """Accepted, or refused for a reason.

    Attributes:
        reason: None if accepted.
        words: what was found.
        cure: what to do about it; empty if accepted.
    """

    reason: Reason | None
    words: str
    cure: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the calibration may be used."""
        return self.reason is None


def refuse(reason: Reason, words: str) -> Verdict:
    """A refusal with its cure."""
    return Verdict(reason, words, _CURES[reason])


def rotation_spread_deg(T: Array) -> Array:
    """(3,) [degrees] turns between the poses (V, 4, 4) about three orthogonal axes, rms, the strongest first."""
    R = T[:, :3, :3]
    i, j = np.triu_indices(len(R), 1)
    turns = log(R[i] @ np.swapaxes(R[j], 1, 2))
    return np.asarray(np.rad2deg(np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1].clip(0))))


def check_rotation(spread_deg: Array) -> Verdict | None:
    """Refuse views that turn too little, or about one axis only."""
    if spread_deg[1] >= MIN_ROTATION_DEG:
        return None
    found = (
        f"the views turn by {spread_deg[0]:.1f} degrees about one axis and by {spread_deg[1]:.1f} about a second one "
        f"(rms between views; {MIN_ROTATION_DEG:.0f} are needed)"
    )
    parallel = "; their axes are parallel" if spread_deg[0] >= 2 * MIN_ROTATION_DEG else ""
    return refuse(Reason.TOO_LITTLE_ROTATION, found + parallel)


def check_scale(scale: float, sigma: float) -> Verdict | None:
    """Refuse a camera whose metre is not the arm's.

    Args:
        scale: true distance over the distance that the camera states.
        sigma: its standard deviation.
    """
    if scale < 0 and -scale > _SCALE_SIGMAS * sigma:
        return refuse(Reason.MIRRORED, "the camera's poses fit the arm's only when one of them is mirrored")
    if not _UNIT_FACTORS[0] < scale < _UNIT_FACTORS[1]:
        return refuse(Reason.WRONG_UNITS, f"the camera's distances and the arm's differ by a factor of {scale:.3g}")
    if abs(scale - 1) > max(MAX_SCALE_ERROR, _SCALE_SIGMAS * sigma):
        return refuse(
            Reason.WRONG_SQUARE_SIZE,
            f"by the arm's motion, the board is {100 * scale:.2f} % of its stated size (+- {100 * sigma:.2f} %)",
        )
    return None


def check_intrinsics(score: float, free_score: float) -> Verdict | None:
    """Refuse intrinsics that cannot be true.

    Args:
        score: held-out error with the intrinsics as they are used.
        free_score: the least with others.
    """
    if free_score >= MAX_INTRINSICS_GAIN * score:
        return None
    return refuse(
        Reason.WRONG_INTRINSICS, f"other intrinsics lower the held-out error from {score:.2f} to {free_score:.2f} px"
    )


def check_result(held_out_mm: float, held_out_deg: float, sigma_mm: float, sigma_deg: float) -> Verdict:
    """Accept a result, or refuse it for its size of error.

    Args:
        held_out_mm: of the median view.
        held_out_deg: likewise.
        sigma_mm: standard deviation of the camera's position in its worst direction.
        sigma_deg: of its rotation, likewise.
    """
    errors = f"held-out error of the median view {held_out_mm:.2f} mm and {held_out_deg:.3f} degrees"
    if held_out_mm > MAX_HELD_OUT_MM or held_out_deg > MAX_HELD_OUT_DEG:
        return refuse(Reason.INCONSISTENT, f"the views contradict each other: {errors}")
    sigmas = f"standard deviation of the result {sigma_mm:.2f} mm and {sigma_deg:.3f} degrees"
    if sigma_mm > MAX_SIGMA_MM or sigma_deg > MAX_SIGMA_DEG:
        return refuse(Reason.UNCERTAIN, f"the views leave the camera's place open: {sigmas}")
    return Verdict(None, f"{errors}; {sigmas}")
