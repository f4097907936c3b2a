from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.geometry.transforms import look_at, transform_points
from robotcell.interfaces import Intrinsics
from sim_twin.d415.rays import RayCaster, ray_directions
from tests.sim_twin.boxes import Box, box_at

SMALL = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=24.0)


@given(
    eye=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.4, 1.0)),
    target=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
)
def test_depth_of_a_plane_is_exact_from_any_place(eye, target):
    T = look_at(eye, (*target, 0.0))
    hits = RayCaster([Box((20.0, 20.0, 0.1))], SMALL, T).cast(np.array([box_at(0, 0, -0.05)]))
    directions = ray_directions(SMALL) @ T[:3, :3].T
    expected = -eye[2] / directions[..., 2]
    seen = (expected > 0) & (expected < 8)  # further out lies the edge of the box
    assert seen.any()
    np.testing.assert_allclose(hits.depth_m[seen], expected[seen], rtol=2e-5)
    np.testing.assert_allclose(hits.normals()[seen], np.broadcast_to((0, 0, 1), hits.normals()[seen].shape), atol=1e-6)


def test_a_box_covers_its_projection_and_nothing_else():
    T = look_at((0, 0, 1), (0, 0, 0))
    boxes = [Box((4, 4, 0.1)), Box((0.2, 0.1, 0.3))]
    hits = RayCaster(boxes, SMALL, T).cast(np.array([box_at(0, 0, -0.05), box_at(0.05, 0.02, 0.15)]))
    points = transform_points(T, ray_directions(SMALL) * 0.7)
    on_top = (abs(points[..., 0] - 0.05) < 0.1) & (abs(points[..., 1] - 0.02) < 0.05)
    np.testing.assert_allclose(hits.depth_m[on_top], 0.7, atol=1e-6)
    assert (hits.visual()[on_top] == 1).all()
    # The camera is nearly above the box, so its sides show as a rim of a few pixels at most.
    assert on_top.sum() <= (hits.visual() == 1).sum() < 2 * on_top.sum()
    assert set(np.unique(hits.visual())) == {0, 1}


def test_normals_face_the_camera_however_triangles_wind():
    box = Box((1, 1, 1))
    inside_out = SimpleNamespace(vertices=box.vertices, triangles=box.triangles[:, ::-1])
    for mesh in (box, inside_out):
        hits = RayCaster([mesh], SMALL, look_at((0, 0, 1), (0, 0, 0))).cast(np.array([box_at(0, 0, 0)]))
        np.testing.assert_allclose(hits.normals()[24, 31], (0, 0, 1), atol=1e-6)


def test_what_meets_nothing_is_zero_depth_and_no_visual():
    T = look_at((0, 0, 1), (0, 0, 0))
    hits = RayCaster([Box((0.1, 0.1, 0.1))], SMALL, T).cast(np.array([box_at(0, 0, 0)]))
    nothing = hits.visual() == -1
    assert nothing[0, 0]
    assert not nothing[24, 31]
    assert (hits.depth_m[nothing] == 0).all()
    assert (hits.normals()[nothing] == 0).all()


def test_poses_of_the_next_frame_move_the_meshes():
    caster = RayCaster([Box((0.2, 0.2, 0.2))], SMALL, look_at((0, 0, 1), (0, 0, 0)))
    assert caster.cast(np.array([box_at(0, 0, 0)])).depth_m[24, 31] == pytest.approx(0.9)
    assert caster.cast(np.array([box_at(0, 0, 0.3)])).depth_m[24, 31] == pytest.approx(0.6)
