"""A push with the closed fingers: what the policy decides, and the motion that it becomes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotcell.motion.rotations import rotation_angle_rad

if TYPE_CHECKING:
    from robotcell.config.schema import Workspace

# A direction whose component along a side of the workspace is smaller never crosses the other one.
_PARALLEL = 1e-9


@dataclass(frozen=True)
class Push:
    """A decision to push.

    Attributes:
        start: (x, y) where the closed fingers come down, base frame [m].
        end: (x, y) where they are lifted again, base frame [m].
        rotation: index k; they move along (cos theta, sin theta) with theta = k * 22.5 degrees about base z.
        top_m: height above the table [m] of the top of what they meet first.
        q_value: what the policy expects of it; comparable only within one policy.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    rotation: int
    top_m: float
    q_value: float

    @property
    def theta(self) -> float:
        """The direction about base z [rad]."""
        return rotation_angle_rad(self.rotation)

    @property
    def length_m(self) -> float:
        """How far the fingers move [m]."""
        return math.dist(self.start, self.end)


def push_in_workspace(
    start: tuple[float, float], rotation: int, length_m: float, top_m: float, q_value: float, workspace: Workspace
) -> Push:
    """The push of a length from a start, cut off where it leaves the workspace; a start beside it is moved to its rim.

    Args:
        start: (x, y) where the fingers come down, base frame [m].
        rotation: index of its direction, see `Push`.
        length_m: at most [m].
        top_m: see `Push`.
        q_value: see `Push`.
        workspace: that it stays in.
    """
    x, y = (min(max(v, low), high) for v, (low, high) in zip(start, (workspace.x, workspace.y), strict=True))
    direction = (math.cos(rotation_angle_rad(rotation)), math.sin(rotation_angle_rad(rotation)))
    for v, d, (low, high) in zip((x, y), direction, (workspace.x, workspace.y), strict=True):
        if abs(d) > _PARALLEL:
            length_m = min(length_m, ((high if d > 0 else low) - v) / d)
    end = (x + length_m * direction[0], y + length_m * direction[1])
    return Push((x, y), end, rotation, top_m, q_value)
