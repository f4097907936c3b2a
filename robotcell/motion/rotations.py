"""The sixteen directions of grasps and pushes."""

from __future__ import annotations

import math

# Index k is a rotation of k * 22.5 degrees about base z (paper: "16 rotations").
ROTATIONS = 16


def rotation_angle_rad(rotation: int) -> float:
    """The angle about base z [rad] of a rotation index."""
    return 2 * math.pi * rotation / ROTATIONS
