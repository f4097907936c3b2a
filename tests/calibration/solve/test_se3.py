from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from calibration.solve.se3 import change, difference, exp, invert, log, nearest_rotation, skew
from robotcell.geometry.transforms import check_transform, make_transform

number = st.floats(-2, 2)
vectors = arrays(np.float64, (5, 3), elements=number)
small = arrays(np.float64, (5, 6), elements=st.floats(-0.5, 0.5))


def transforms(rotvecs: np.ndarray, positions: np.ndarray) -> np.ndarray:
    return np.stack([make_transform(R, t) for R, t in zip(exp(rotvecs), positions, strict=True)])


@given(vectors, vectors)
def test_the_inverse_undoes_a_transform(rotvecs: np.ndarray, positions: np.ndarray) -> None:
    T = transforms(rotvecs, positions)
    np.testing.assert_allclose(invert(T) @ T, np.tile(np.eye(4), (5, 1, 1)), atol=1e-12)


@given(vectors, vectors, small)
def test_a_change_is_what_the_difference_says(rotvecs: np.ndarray, positions: np.ndarray, delta: np.ndarray) -> None:
    T = transforms(rotvecs, positions)
    np.testing.assert_allclose(difference(change(T, delta), T), delta, atol=1e-9)


@given(vectors)
def test_log_inverts_exp(rotvecs: np.ndarray) -> None:
    assume((np.linalg.norm(rotvecs, axis=1) < np.pi - 1e-3).all())
    np.testing.assert_allclose(log(exp(rotvecs)), rotvecs, atol=1e-8)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-12)


@given(arrays(np.float64, (4, 3, 3), elements=number))
def test_the_nearest_rotation_is_right_handed(matrices: np.ndarray) -> None:
    for R in nearest_rotation(matrices):
        check_transform(make_transform(R, np.zeros(3)), "T")


@given(vectors)
def test_a_rotation_is_its_own_nearest(rotvecs: np.ndarray) -> None:
    np.testing.assert_allclose(nearest_rotation(exp(rotvecs)), exp(rotvecs), atol=1e-9)


def test_a_mirrored_matrix_becomes_a_rotation() -> None:
    R = nearest_rotation(np.diag([1.0, 1.0, -1.0])[None])[0]
    assert np.linalg.det(R) == pytest.approx(1.0)
