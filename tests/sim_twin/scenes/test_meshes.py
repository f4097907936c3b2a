import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.geometry.transforms import rotvec_to_matrix
from sim_twin.scenes.meshes import Mesh, hull, mesh_centroid, mesh_inertia, mesh_volume

EDGES = np.array([0.1, 0.06, 0.02])
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * EDGES

vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@given(rotvec=vectors, shift=vectors)
def test_a_moved_box_keeps_its_volume_and_moments(rotvec, shift):
    R = rotvec_to_matrix(rotvec)
    box = hull(CORNERS)
    moved = Mesh(box.vertices @ R.T + shift, box.triangles)
    volume = EDGES.prod()
    squares = EDGES**2
    moments = volume / 12 * (squares.sum() - squares)
    assert mesh_volume(moved) == pytest.approx(volume, rel=1e-6)
    assert mesh_centroid(moved) == pytest.approx(R @ (EDGES / 2) + shift, abs=1e-9)
    np.testing.assert_allclose(mesh_inertia(moved), R @ np.diag(moments) @ R.T, atol=1e-6 * moments.max())


def test_points_in_a_plane_have_no_hull():
    with pytest.raises(ValueError, match="in a plane"):
        hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))
