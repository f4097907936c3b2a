"""What turns pixels into points: pose, refined intrinsics and depth correction, together."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.config import Workspace
from robotcell.config.calibration_file import CameraModel, DepthCorrection
from robotcell.errors import CalibrationError
from robotcell.geometry.transforms import look_at, transform_points
from robotcell.interfaces import Intrinsics, RgbdFrame
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.heightmap import build_heightmap

# What the device says of itself, and what is true.
SAID = Intrinsics(320, 240, 309.0, 309.0, 160.0, 120.0)
TRUE = CameraModel(
    width=320, height=240, fx=316.0, fy=315.0, cx=163.0, cy=118.0, dist=(0.06, -0.04, 0.001, -0.001, 0.0)
)
T_BASE_CAMERA = look_at((-0.75, 0.02, 0.78), (-0.5, 0.0, 0.0))
DEPTH = DepthCorrection(scale=0.98, offset_m=0.004)
ALL = (slice(0, 240), slice(0, 320))


def frame(depth_m: np.ndarray) -> RgbdFrame:
    return RgbdFrame(0.0, 1, np.full((240, 320, 3), 90, np.uint8), depth_m.astype(np.float32), SAID)


def seen(plane_m: float) -> np.ndarray:
    """The depth (H, W) [m] along the optical axis that the true camera sees of a plane that high."""
    rays = CalibratedCamera(T_BASE_CAMERA, TRUE).rays(SAID, ALL)
    return np.asarray((plane_m - T_BASE_CAMERA[2, 3]) / rays[2])


@settings(max_examples=30)
@given(st.floats(-0.7, -0.3), st.floats(-0.2, 0.2), st.floats(0.0, 0.1))
def test_a_point_lies_on_the_ray_of_the_pixel_that_it_is_projected_to(x: float, y: float, z: float) -> None:
    for camera in (CalibratedCamera(T_BASE_CAMERA), CalibratedCamera(T_BASE_CAMERA, TRUE)):
        u, v, depth = camera.project(np.array([[x, y, z]]), SAID)[0]
        rays = camera.rays(SAID, ALL)
        if 1 <= u < 318 and 1 <= v < 238:
            # Between the four pixels around it, the rays are as good as linear.
            patch = np.stack([cv2.getRectSubPix(ray.astype(np.float32), (1, 1), (u, v))[0, 0] for ray in rays])
            np.testing.assert_allclose(camera.position + depth * patch, (x, y, z), atol=2e-4)


def test_without_a_calibration_the_frame_holds() -> None:
    camera = CalibratedCamera(T_BASE_CAMERA)
    points = np.array([[-0.5, 0.0, 0.0], [-0.4, 0.1, 0.05]])
    inside = transform_points(np.linalg.inv(T_BASE_CAMERA), points)
    expected = inside[:, :2] / inside[:, 2:] * (SAID.fx, SAID.fy) + (SAID.cx, SAID.cy)
    np.testing.assert_allclose(camera.project(points, SAID), np.column_stack([expected, inside[:, 2]]))


def test_depth_is_corrected_and_no_return_stays_none() -> None:
    depth = np.full((240, 320), 0.8)
    depth[0, 0] = 0.0
    corrected = CalibratedCamera(T_BASE_CAMERA, None, DEPTH).depth_m(frame(depth))
    assert corrected[0, 0] == 0
    assert corrected[1, 1] == pytest.approx(0.98 * 0.8 + 0.004, abs=1e-6)


@pytest.mark.parametrize("height_m", [0.0, 0.05, 0.1])
def test_a_heightmap_is_right_with_the_correction_and_wrong_without(height_m: float) -> None:
    measured = frame((seen(height_m) - DEPTH.offset_m) / DEPTH.scale)
    right = build_heightmap(measured, CalibratedCamera(T_BASE_CAMERA, TRUE, DEPTH), Workspace(), 0.0)
    wrong = build_heightmap(measured, CalibratedCamera(T_BASE_CAMERA), Workspace(), 0.0)
    assert right.coverage > 0.2
    np.testing.assert_allclose(right.height_m[np.isfinite(right.height_m)], height_m, atol=2e-4)
    assert np.nanmedian(np.abs(wrong.height_m - height_m)) > 0.005


def test_a_frame_of_another_resolution_is_refused() -> None:
    model = TRUE.model_copy(update={"width": 640, "height": 480})
    with pytest.raises(CalibrationError, match="the calibration is of 640x480 and the frame of 320x240 pixels"):
        build_heightmap(frame(np.ones((240, 320))), CalibratedCamera(T_BASE_CAMERA, model), Workspace(), 0.0)
