from collections import Counter

import numpy as np
import pytest

from robotcell.errors import ConfigError
from sim_twin.scenes.convex_parts import convex_parts
from sim_twin.scenes.meshes import hull, mesh_centroid, mesh_volume
from sim_twin.scenes.shapes import BLOCK_NAMES, block

EXTENTS_MM = {
    "triangular_prism": (93, 50, 49),
    "arch": (100, 50, 50),
    "hexagonal_slab": (25, 60, 60),
    "plank": (100, 50, 25),
    "cube": (50, 50, 50),
    "tall_block": (50, 50, 100),
    "half_round_slab": (50, 50, 25),
    "cylinder": (45, 45, 50),
}


def test_the_eight_blocks_are_there():
    assert set(BLOCK_NAMES) == set(EXTENTS_MM)


@pytest.mark.parametrize("name", BLOCK_NAMES)
def test_a_block_has_its_size_and_its_centre_of_mass_at_the_origin(name):
    shape = block(name)
    np.testing.assert_allclose(1000 * np.ptp(shape.mesh.vertices, axis=0), EXTENTS_MM[name], atol=1e-6)
    np.testing.assert_allclose(mesh_centroid(shape.mesh), 0, atol=1e-9)
    assert shape.volume_m3 == pytest.approx(mesh_volume(shape.mesh))


@pytest.mark.parametrize("name", BLOCK_NAMES)
def test_a_block_is_watertight(name):
    triangles = block(name).mesh.triangles
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3))
    assert all(n == 1 and edges[b, a] == 1 for (a, b), n in list(edges.items()))


@pytest.mark.parametrize("name", BLOCK_NAMES)
def test_the_parts_are_convex_and_fill_the_block(name):
    shape = block(name)
    for part in shape.parts:
        assert mesh_volume(part) == pytest.approx(mesh_volume(hull(part.vertices)), rel=1e-6)
    assert sum(mesh_volume(part) for part in shape.parts) == pytest.approx(shape.volume_m3, rel=0.01)


def test_the_arch_collides_as_three_pieces_that_leave_its_opening_free():
    arch = block("arch")
    assert len(arch.parts) == 3
    low = arch.mesh.vertices.min(axis=0)
    in_the_opening = low + np.array([0.05, 0.025, 0.015])
    for part in arch.parts:
        corners = part.vertices[part.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("mi,mi->m", normals, in_the_opening - corners[:, 0]) > 0).any()


def test_a_foreign_arch_is_decomposed_by_the_general_rule():
    arch = block("arch")
    assert mesh_volume(hull(arch.mesh.vertices)) > 1.2 * arch.volume_m3
    assert sum(mesh_volume(part) for part in convex_parts(arch.mesh)) < 1.05 * arch.volume_m3


def test_an_unknown_block_is_refused_with_the_list():
    with pytest.raises(ConfigError, match=r"'ball'.*tall_block"):
        block("ball")
