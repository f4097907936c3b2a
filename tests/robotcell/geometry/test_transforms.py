from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robotcell.geometry.transforms import (
    check_transform,
    cross,
    interpolate_transforms,
    invert_transform,
    look_at,
    make_transform,
    matrix_to_rotvec,
    rotation_angle,
    rotation_z,
    rotvec_to_matrix,
    transform_points,
)

coordinate = st.floats(-2, 2)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
transforms = st.builds(lambda r, t: make_transform(rotvec_to_matrix(r), t), vector, vector)


@given(transforms, vector)
def test_inverse_brings_a_point_back(T: np.ndarray, point: np.ndarray) -> None:
    np.testing.assert_allclose(transform_points(invert_transform(T), transform_points(T, point)), point, atol=1e-9)


@given(vector, vector)
def test_cross_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-12)


@given(vector)
def test_rotation_vectors_round_trip(rotvec: np.ndarray) -> None:
    assume(np.linalg.norm(rotvec) < np.pi - 1e-3)
    np.testing.assert_allclose(matrix_to_rotvec(rotvec_to_matrix(rotvec)), rotvec, atol=1e-9)


@given(vector)
def test_rotation_vectors_are_those_of_scipy(rotvec: np.ndarray) -> None:
    there = Rotation.from_rotvec(rotvec)
    np.testing.assert_allclose(rotvec_to_matrix(rotvec), there.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotvec_to_matrix([rotvec, -rotvec])[1], there.inv().as_matrix(), atol=1e-12)
    assume(there.magnitude() < np.pi - 1e-3)
    np.testing.assert_allclose(matrix_to_rotvec(there.as_matrix()), there.as_rotvec(), atol=1e-9)


def test_half_a_turn_has_a_rotation_vector() -> None:
    for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, 0.8)):
        R = rotvec_to_matrix(np.pi * np.array(axis))
        np.testing.assert_allclose(rotvec_to_matrix(matrix_to_rotvec(R)), R, atol=1e-12)
    assert not matrix_to_rotvec(np.eye(3)).any()


@given(transforms, transforms, st.floats(0, 1))
def test_interpolation_is_straight_and_even(T_a: np.ndarray, T_b: np.ndarray, s: float) -> None:
    angle = rotation_angle(T_a[:3, :3], T_b[:3, :3])
    assume(angle < np.pi - 1e-3)
    (T,) = interpolate_transforms(T_a, T_b, s)
    np.testing.assert_allclose(T[:3, 3], (1 - s) * T_a[:3, 3] + s * T_b[:3, 3], atol=1e-9)
    assert rotation_angle(T_a[:3, :3], T[:3, :3]) == pytest.approx(s * angle, abs=1e-6)
    check_transform(T, "T")


@given(vector, vector)
def test_camera_sees_its_target_on_the_axis(eye: np.ndarray, target: np.ndarray) -> None:
    assume(np.linalg.norm(target - eye) > 1e-3)
    T_base_camera = check_transform(look_at(eye, target), "T_base_camera")
    seen = transform_points(invert_transform(T_base_camera), target)
    np.testing.assert_allclose(seen, (0, 0, np.linalg.norm(target - eye)), atol=1e-7)


def test_camera_image_is_upright() -> None:
    # OpenCV axes: y points down in the image, so it must point down in the world.
    assert look_at((1, 0, 1), (0, 0, 0))[2, 1] < 0


def test_look_at_needs_two_points() -> None:
    with pytest.raises(ValueError, match="coincide"):
        look_at((1, 2, 3), (1, 2, 3))


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
        (np.diag([2.0, 1.0, 1.0, 1.0]), "not rigid"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrored"),
    ],
)
def test_a_bad_transform_is_named(matrix: np.ndarray, reason: str) -> None:
    with pytest.raises(ValueError, match=rf"T_base_camera.*{reason}"):
        check_transform(matrix, "T_base_camera")


def test_rotation_z_turns_x_to_y() -> None:
    np.testing.assert_allclose(rotation_z(np.pi / 2) @ (1, 0, 0), (0, 1, 0), atol=1e-12)
