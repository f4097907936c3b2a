"""A joint path of several legs whose corners are rounded, so that the arm need not stop at them.

Within the blend radius of a corner the legs give way to a cubic curve in joint space that leaves the one and joins the
next along their tangents; between two joint-space legs it is a parabola. What is checked before a motion and what the
twins drive is this same curve. How the real controller rounds inside the radius is not public.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.geometry import ur5e

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.geometry.transforms import Array

# How much of a leg a corner may take: two corners never meet (UR's manual: radii must not overlap), and a leg that ends
# at rest keeps a little of its own.
_SHARE_OF_TWO = 0.5
_SHARE_OF_ONE = 0.95


@dataclass(frozen=True)
class RoundedPath:
    """Samples along a path, from its start to its end.

    Attributes:
        q: (N, 6) joint angles [rad].
        leg: (N,) the leg that each sample belongs to; it changes in the middle of a corner.
        other: (N,) within a corner the other leg that meets there; elsewhere `leg`.
    """

    q: Array
    leg: npt.NDArray[np.int64]
    other: npt.NDArray[np.int64]


def round_corners(
    legs: Sequence[Array], blends_m: Sequence[float], T_flange_tcp: Array, corner_samples: int
) -> RoundedPath:
    """Round the corners between legs.

    Args:
        legs: each the joint angles (N_i, 6) [rad] along it, both ends included, each but the first starting where the
            one before ends; N_i >= 2.
        blends_m: for each leg how far [m] the tcp may be from the leg's end when the path leaves it, 0 or more; the
            last leg's is not used. Of a leg with a corner at both ends each takes at most half.
        T_flange_tcp: (4, 4) the tool.
        corner_samples: on each rounded corner, ends included; >= 4.
    """
    begins, ends = [0.0] * len(legs), [len(leg) - 1.0 for leg in legs]
    corners: list[Array | None] = [None] * len(legs)
    for i, blend_m in enumerate(blends_m[: len(legs) - 1]):
        if blend_m <= 0:
            continue
        before, after = legs[i], legs[i + 1]
        # Along both legs the corner begins where the tool comes within the radius.
        rounded_before = i > 0 and blends_m[i - 1] > 0
        rounded_after = i + 2 < len(legs) and blends_m[i + 1] > 0
        leave = len(before) - 1 - _within(before[::-1], blend_m, T_flange_tcp, two_corners=rounded_before)
        join = _within(after, blend_m, T_flange_tcp, two_corners=rounded_after)
        if leave >= len(before) - 1 or join <= 0:
            continue
        ends[i], begins[i + 1] = leave, join
        q_leave, slope_leave = _at(before, leave)
        q_join, slope_join = _at(after, join)
        control = (
            q_leave,
            q_leave + 2 / 3 * (len(before) - 1 - leave) * slope_leave,
            q_join - 2 / 3 * join * slope_join,
            q_join,
        )
        corners[i] = _bezier(control, np.linspace(0.0, 1.0, corner_samples))
    q: list[Array] = []
    owners: list[tuple[int, int]] = []

    def add(samples: Array, leg: int, other: int) -> None:
        q.append(samples)
        owners.extend([(leg, other)] * len(samples))

    for i, leg in enumerate(legs):
        inner = leg[int(np.floor(begins[i])) + 1 : int(np.ceil(ends[i]))]
        # A corner's ends stand for those of the body beside it.
        first = leg[:1] if begins[i] == 0.0 and (i == 0 or corners[i - 1] is None) else leg[:0]
        add(np.vstack([first, inner]), i, i)
        corner = corners[i]
        if corner is None:
            add(leg[-1:], i, i)
        else:
            half = (len(corner) + 1) // 2
            add(corner[:half], i, i + 1)
            add(corner[half:], i + 1, i)
    owner = np.array(owners, np.int64)
    return RoundedPath(np.vstack(q), owner[:, 0], owner[:, 1])


def _within(leg: Array, radius_m: float, T_flange_tcp: Array, *, two_corners: bool) -> float:
    """The index, with its fraction, up to which the tool stays within a radius of where the leg starts."""
    tcp = (ur5e.forward(leg) @ T_flange_tcp)[:, :3, 3]
    distance = np.linalg.norm(tcp - tcp[0], axis=1)
    latest = (_SHARE_OF_TWO if two_corners else _SHARE_OF_ONE) * (len(leg) - 1)
    outside = np.flatnonzero(distance > radius_m)
    if not outside.size:
        return latest
    k = int(outside[0])
    fraction = (radius_m - distance[k - 1]) / (distance[k] - distance[k - 1])
    return float(min(k - 1 + fraction, latest))


def _at(leg: Array, index: float) -> tuple[Array, Array]:
    """Joint angles (6,) at an index with a fraction, and their slope (6,) per sample."""
    k = min(int(index), len(leg) - 2)
    slope = leg[k + 1] - leg[k]
    return leg[k] + (index - k) * slope, slope


def _bezier(control: tuple[Array, Array, Array, Array], u: Array) -> Array:
    a, b, c, d = control
    u = u[:, None]
    return np.asarray((1 - u) ** 3 * a + 3 * (1 - u) ** 2 * u * b + 3 * (1 - u) * u**2 * c + u**3 * d)
