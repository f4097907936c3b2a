from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from robotcell.geometry import ur5e

joints = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)


def test_flange_pose_matches_the_controller_convention() -> None:
    # The flange position that the controller's own forward kinematics gives for these joints.
    q = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
    np.testing.assert_allclose(ur5e.forward(q)[:3, 3], (-0.4922, -0.1334, 0.4878), atol=1e-4)


@given(joints)
def test_inverse_returns_the_nearest_solution(q: np.ndarray) -> None:
    assume(ur5e.distance_to_singularity(q) > 0.02)
    solution = ur5e.inverse(ur5e.forward(q), q)
    assert solution is not None
    np.testing.assert_allclose(solution, q, atol=1e-6)


@given(joints, st.integers(0, 5))
def test_jacobian_is_the_derivative(q: np.ndarray, joint: int) -> None:
    h = 1e-6
    step = h * np.eye(6)[joint]
    before, after = ur5e.forward(q - step), ur5e.forward(q + step)
    J = ur5e.jacobian(q)[:, joint]
    np.testing.assert_allclose((after - before)[:3, 3] / (2 * h), J[:3], atol=1e-6)
    spin = (after - before)[:3, :3] / (2 * h) @ ur5e.forward(q)[:3, :3].T
    np.testing.assert_allclose((spin[2, 1], spin[0, 2], spin[1, 0]), J[3:], atol=1e-6)


@given(joints, joints)
def test_tool_speed_is_that_of_the_point_before_the_flange(q: np.ndarray, qd: np.ndarray) -> None:
    h = 1e-6
    tool = np.array([0.0, 0.0, 0.2, 1.0])
    before, after = (ur5e.forward(q + sign * h * qd) @ tool for sign in (-1, 1))
    assert ur5e.tool_speed(q, qd, 0.2) == pytest.approx(np.linalg.norm(after - before) / (2 * h), abs=1e-5)


def test_the_stretched_arm_is_singular() -> None:
    assert ur5e.distance_to_singularity((0.0, -1.0, 0.0, -1.0, -1.57, 0.0)) < 1e-9
    assert ur5e.distance_to_singularity((0.0, -1.57, 1.57, -1.57, -1.57, 0.0)) > 0.05


def test_joint_angles_stay_in_the_turn_they_are_in() -> None:
    q = np.array([0.3, -1.8, 1.9, -1.6, -1.57, 6.0])
    solution = ur5e.inverse(ur5e.forward(q), q)
    assert solution is not None
    np.testing.assert_allclose(solution, q, atol=1e-6)


def test_a_pose_out_of_reach_has_no_solution() -> None:
    T = ur5e.forward((0.0, -1.57, 1.57, -1.57, -1.57, 0.0))
    T[0, 3] = -1.5
    assert ur5e.inverse(T, np.zeros(6)) is None


def test_a_path_says_where_it_leaves_the_reach() -> None:
    q = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
    path = np.tile(ur5e.forward(q), (3, 1, 1))
    path[1, 0, 3] = -1.5
    with pytest.raises(ValueError, match=r"cannot reach x -1\.500"):
        ur5e.inverse_along(path, q, max_step=0.3)


def test_a_path_through_a_jump_is_refused() -> None:
    q = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
    path = np.stack([ur5e.forward(q), ur5e.forward(q + 0.5)])
    with pytest.raises(ValueError, match="singularity"):
        ur5e.inverse_along(path, q, max_step=0.3)


def test_a_last_joint_at_zero_is_not_lost() -> None:
    q = np.array([0.29999851, -1.56945313, 1.53502448, -1.53557135, -1.57, 0.0])
    lost = []
    # The solver alone loses one in ten of these.
    for last in np.linspace(-2e-12, 2e-12, 401):
        q[5] = last
        found = ur5e.inverse(ur5e.forward(q), q + 0.001)
        if found is None or np.abs(found - q).max() > 1e-6:
            lost.append(last)
    assert not lost
