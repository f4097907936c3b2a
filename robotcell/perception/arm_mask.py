"""Which pixels may show the arm: what is seen there is no thing that stands on the table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.geometry import bodies, rg2, ur5e

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Intrinsics
    from robotcell.perception.calibrated_camera import CalibratedCamera

# Around the bodies: errors of camera and kinematics, the way of the arm between two measurements, the edges of depth.
_MARGIN_M = 0.030
# A load reaches so far from the tip to any side.
_LOAD_M = 0.080


def arm_mask(q: Array, camera: CalibratedCamera, intrinsics: Intrinsics) -> npt.NDArray[np.bool_]:
    """(H, W) pixels that may show arm, gripper or a load at joint angles (6,) [rad]."""
    T_tcp = ur5e.forward(q) @ rg2.T_FLANGE_TCP
    fingers = bodies.finger_points(T_tcp, 0.0)
    centers = np.concatenate([bodies.sphere_centers(q), fingers, T_tcp[None, :3, 3]])
    radii = np.concatenate([bodies.SPHERES.radius, np.full(len(fingers), bodies.FINGER_SPACING_M), [_LOAD_M]])
    mask = np.zeros((intrinsics.height, intrinsics.width), np.uint8)
    for (u, v, depth), radius in zip(camera.project(centers, intrinsics), radii + _MARGIN_M, strict=True):
        # What the camera stands in, or behind which it stands, is in no picture.
        if depth > 2 * radius and max(abs(u), abs(v)) < 4 * intrinsics.width:
            cv2.circle(mask, (round(u), round(v)), int(np.ceil(intrinsics.fx * radius / (depth - radius))), 1, -1)
    return mask > 0
