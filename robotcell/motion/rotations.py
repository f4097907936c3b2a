"""The sixteen directions of grasps and pushes."""

from __future__ import annotations

import math

# Index k is a rotation of k * 22.5 degrees about base z (paper: "16 rotations").
ROTATIONS = 16
# A parallel gripper that is turned by half a turn closes the same way.
GRASP_ROTATIONS = ROTATIONS // 2


def rotation_angle_rad(rotation: int) -> float:
    """The angle about base z [rad] of a rotation index."""
    return 2 * math.pi * rotation / ROTATIONS
