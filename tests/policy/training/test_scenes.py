"""Scenes to learn from. Seeds are fixed: hypothesis draws them, derandomized."""

from itertools import combinations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy.training.environment import PushGraspEnv
from policy.training.scenes import training_scene
from robotcell.config import load_config


def footprint(item):
    """Convex outline on the table [mm] and the lowest point above z = 0 [m]."""
    points = item.shape.mesh.vertices @ item.T_base_object[:3, :3].T + item.T_base_object[:3, 3]
    return cv2.convexHull(np.float32(1000 * points[:, :2])), float(points[:, 2].min())


@pytest.mark.parametrize("kind", ["packed", "enclosed"])
@settings(max_examples=20, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 12))
def test_what_stands_in_a_group_stands_beside_the_others_on_the_table(kind, seed, count):
    config = load_config()
    scene = training_scene(kind, count, config, np.random.default_rng(seed))
    assert len(scene.objects) == count
    outlines, lowest = zip(*(footprint(item) for item in scene.objects), strict=True)
    assert np.allclose(lowest, config.table.height_m, atol=0.002)
    for one, other in combinations(outlines, 2):
        shared, _ = cv2.intersectConvexConvex(one, other)
        assert shared < 1.0  # mm2


def test_others_stand_close_around_an_enclosed_object(request):
    env = PushGraspEnv(load_config(), stage=2)
    request.addfinalizer(env.close)
    occupied = []
    for seed in range(1_500_000, 1_500_004):
        env.reset(seed=seed, options={"kind": "enclosed", "count": 5})
        occupied.append(env.state.occupied[1])
    assert min(occupied) > 0.15
