from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.config import CellConfig, KeepOut
from robotcell.geometry import bodies, ur5e

BOX = KeepOut(name="box", x=(-1, 1), y=(0, 2), z=(0, 0.5))
coordinate = st.floats(-3, 3)


@given(st.tuples(coordinate, coordinate, coordinate).map(np.array))
def test_distance_to_a_box_is_that_to_its_nearest_point(point: np.ndarray) -> None:
    nearest = np.clip(point, (-1, 0, 0), (1, 2, 0.5))
    assert bodies.box_distance(BOX, point) == pytest.approx(np.linalg.norm(point - nearest), abs=1e-12)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array))
def test_spheres_follow_their_links(q: np.ndarray) -> None:
    centers, frames = bodies.sphere_centers(q), ur5e.link_frames(q)
    for sphere in (0, len(centers) - 1):
        T = frames[bodies.SPHERES.link[sphere]]
        np.testing.assert_allclose(centers[sphere], T[:3, :3] @ bodies.SPHERES.center[sphere] + T[:3, 3], atol=1e-12)


def test_spheres_of_a_body_leave_no_gap_and_reach_from_base_to_palm() -> None:
    centers = bodies.sphere_centers(np.array(CellConfig().motion.home_q))
    spheres = bodies.SPHERES
    for group in np.unique(spheres.group):
        chain = centers[spheres.group == group]
        assert np.linalg.norm(np.diff(chain, axis=0), axis=1).max() < spheres.radius[spheres.group == group].min()
    # Each body begins within a housing of the one before.
    for group in np.unique(spheres.group)[1:]:
        first = centers[spheres.group == group][0]
        before = centers[spheres.group < group]
        reach = spheres.radius[spheres.group < group] + spheres.radius[spheres.group == group][0]
        assert (np.linalg.norm(before - first, axis=1) < reach).any()


def test_an_upright_arm_is_clear_of_itself_and_a_folded_one_is_not() -> None:
    upright = np.array([0, -np.pi / 2, 0, -np.pi / 2, 0, 0])
    folded = np.array([0, -np.pi / 2, 2.9, 0, 0, 0])
    clear, close = bodies.self_distance(bodies.sphere_centers(np.stack([upright, folded])))
    assert clear > 0
    assert close < 0


def test_the_post_stands_behind_the_camera_and_a_hanging_camera_has_none() -> None:
    config = CellConfig()
    post = bodies.camera_post(config)
    assert post is not None
    assert post.x[1] < config.camera.position[0] < config.workspace.x[0]
    above = CellConfig.model_validate({"camera": {"position": (-0.5, 0.0, 0.9), "look_at": (-0.5, 0.0, 0.0)}})
    assert bodies.camera_post(above) is None
    assert [box.name for box in bodies.obstacles(above)] == ["bin", "camera"]
