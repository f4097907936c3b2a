"""The task frames of force mode."""

from __future__ import annotations

import numpy as np
import pytest

from robotcell.geometry.transforms import make_transform, rotation_z
from sim_twin.wire.ur.force_mode import along_motion, towards_origin

FRAME = make_transform(rotation_z(0.4), (0.5, -0.2, 0.1))


@pytest.mark.parametrize("tool", [(0.3, 0.3, 0.4), (-0.2, 0.1, 0.1)])
def test_the_y_axis_points_from_the_tool_to_the_point(tool: tuple[float, float, float]) -> None:
    axes = towards_origin(FRAME, np.array(tool))
    way = FRAME[:3, 3] - tool
    np.testing.assert_allclose(axes[:, 1], way / np.linalg.norm(way), atol=1e-12)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    # The x axis stays in the plane of the frame.
    assert axes[:, 0] @ FRAME[:3, 2] == pytest.approx(0, abs=1e-12)


def test_a_tool_at_the_point_keeps_the_axes_of_the_frame() -> None:
    np.testing.assert_array_equal(towards_origin(FRAME, FRAME[:3, 3].copy()), FRAME[:3, :3])


def test_the_x_axis_points_along_the_motion_in_the_plane_of_the_frame() -> None:
    axes = along_motion(FRAME, np.array([0.3, 0.4, -0.7]))
    np.testing.assert_allclose(axes[:, 0], (0.6, 0.8, 0), atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], FRAME[:3, 2], atol=1e-12)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


@pytest.mark.parametrize("speed", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.2)])
def test_a_motion_across_the_plane_keeps_the_axes_of_the_frame(speed: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(along_motion(FRAME, np.array(speed)), FRAME[:3, :3], atol=1e-12)
