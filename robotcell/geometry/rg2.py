"""The RG2's four-bar linkage: how far the finger tips reach at each opening.

Each finger hangs on two parallel cranks, so it keeps its direction while its tip moves on an arc. With the crank
at angle alpha from the approach axis, half the opening is L (sin alpha - sin alpha_closed) and the tip has drawn
back by L (cos alpha_closed - cos alpha).

Sources: crank length L = 55 mm is that of the public RG2 models (pivot offsets 39.592 and 38.177 mm); stroke
110 mm and closed length 213 mm are datasheet values; the closed angle is the one that gives the 40 mm by which the
tips of a real RG2 were measured to draw back over the stroke (85 mm closed, 45 mm open, from the palm).

Mounted tips shift the openings: each reaches inwards from the bare finger by the fingertip offset, or outwards where
that is negative. They are taken to be as long as the bare fingers.
"""

from __future__ import annotations

import math

import numpy as np

from robotcell.geometry.transforms import make_transform
from robotcell.interfaces import GripperRange

CRANK_LENGTH_M = 0.055
CLOSED_ANGLE = -0.0380
MIN_WIDTH_M = 0.0
MAX_WIDTH_M = 0.110
MIN_FORCE_N = 3.0
MAX_FORCE_N = 40.0
# Flange to the tips of the closed fingers: the tcp.
CLOSED_LENGTH_M = 0.213
# The tcp: between the tips of the closed fingers, axes of the flange. The fingers close along its x axis.
T_FLANGE_TCP = make_transform(np.eye(3), (0.0, 0.0, CLOSED_LENGTH_M))
# Flange to palm, and to the pivots of the cranks.
PALM_M, PIVOTS_M = 0.128, 0.126
# The closed cranks, along the closing direction and across it, from the middle, and their lower ends above the tips;
# the body of the gripper likewise (public RG2 models, rounded).
CRANKS_M, CRANKS_ABOVE_TIPS_M = (0.022, 0.012), CLOSED_LENGTH_M - PIVOTS_M - CRANK_LENGTH_M
BODY_M, BODY_ABOVE_TIPS_M = (0.035, 0.024), CLOSED_LENGTH_M - PALM_M
# A finger's knuckle above its tip; the outer crank's pivot from the middle (public RG2 models, rounded).
KNUCKLE_TO_TIP_M = CLOSED_LENGTH_M - PIVOTS_M - CRANK_LENGTH_M * math.cos(CLOSED_ANGLE)
PIVOT_OFFSET_M = 0.017
# A finger tip, across the closing direction and along it. Measured from the public RG2 models.
FINGER_BREADTH_M = 0.022
FINGER_THICKNESS_M = 0.010
# Of sums of widths and offsets.
_ROUNDING_M = 1e-9


def crank_angle(width_m: float) -> float:
    """Angle [rad] of the cranks from the approach axis at an opening between the bare fingers.

    Raises:
        ValueError: the linkage cannot reach that opening.
    """
    if not MIN_WIDTH_M - _ROUNDING_M <= width_m <= MAX_WIDTH_M + _ROUNDING_M:
        raise ValueError(
            f"opening {1000 * width_m:.1f} mm is outside the RG2's range of "
            f"{1000 * MIN_WIDTH_M:.0f} to {1000 * MAX_WIDTH_M:.0f} mm"
        )
    return math.asin(math.sin(CLOSED_ANGLE) + width_m / (2 * CRANK_LENGTH_M))


def width_at(angle: float) -> float:
    """Opening [m] between the bare fingers at a crank angle [rad]; the inverse of `crank_angle`."""
    return 2 * CRANK_LENGTH_M * (math.sin(angle) - math.sin(CLOSED_ANGLE))


def range_with_tips(fingertip_offset_m: float) -> GripperRange:
    """What the RG2 reaches with mounted tips; its register of the width takes at most 110 mm, whatever they are."""
    shift = -2 * fingertip_offset_m
    return GripperRange(
        fingertip_offset_m=fingertip_offset_m,
        min_width_m=max(MIN_WIDTH_M, MIN_WIDTH_M + shift),
        max_width_m=min(MAX_WIDTH_M, MAX_WIDTH_M + shift),
        min_force_n=MIN_FORCE_N,
        max_force_n=MAX_FORCE_N,
    )


def finger_thickness(fingertip_offset_m: float) -> float:
    """How thick [m] a finger is with its tip; a tip that is set back makes it no thinner."""
    return FINGER_THICKNESS_M + max(0.0, fingertip_offset_m)


def tip_retraction(width_m: float, fingertip_offset_m: float = 0.0) -> float:
    """How far [m] the finger tips are behind the tcp (towards the flange) at an opening between the mounted tips.

    Zero when the bare fingers are closed, up to 40 mm when they are open.

    Raises:
        ValueError: the linkage cannot reach that opening.
    """
    return CRANK_LENGTH_M * (math.cos(CLOSED_ANGLE) - math.cos(crank_angle(width_m + 2 * fingertip_offset_m)))
