"""A grasp from above: what the policy decides, and the motion that it becomes."""

from __future__ import annotations

from dataclasses import dataclass

from robotcell.motion.rotations import rotation_angle_rad


@dataclass(frozen=True)
class Grasp:
    """A decision to grasp.

    Attributes:
        x, y: middle between the fingers, base frame [m].
        surface_m: height of the surface there above the table [m].
        rotation: index k; the fingers close along (cos theta, sin theta) with theta = k * 22.5 degrees about base z.
        q_value: what the policy expects of it; comparable only within one policy.
    """

    x: float
    y: float
    surface_m: float
    rotation: int
    q_value: float

    @property
    def theta(self) -> float:
        """The closing direction about base z [rad]."""
        return rotation_angle_rad(self.rotation)
