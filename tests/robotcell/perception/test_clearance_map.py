"""The map of clearance, by frames of made-up boxes on a table."""

from __future__ import annotations

import numpy as np
import pytest

from robotcell.config import CameraMount
from robotcell.config.schema import KeepOut
from robotcell.interfaces import Intrinsics, RgbdFrame
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.clearance_map import RESOLUTION_M, TALLEST_BLOCK_M, build_clearance_map

OPTICS = Intrinsics(320, 240, 308.6, 308.6, 160.0, 120.0)
CAMERA = CalibratedCamera(CameraMount().pose())
EYE_M = 0.8
# How much too high what is seen may be said to be: the steps of the map and the footprint of a cell.
ROUNDING_M = 0.035


def frame_of(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> RgbdFrame:
    """What a perfect camera sees of boxes (corner, opposite corner) that stand on the table."""
    rays = CAMERA.rays(OPTICS, (slice(0, OPTICS.height), slice(0, OPTICS.width)))
    depth = -CAMERA.position[2] / rays[2]
    for low, high in boxes:
        with np.errstate(divide="ignore"):
            a, b = ((np.array(c)[:, None, None] - CAMERA.position[:, None, None]) / rays for c in (low, high))
        near, far = np.minimum(a, b).max(axis=0), np.maximum(a, b).min(axis=0)
        depth = np.where((near < far) & (near > 0), np.minimum(depth, near), depth)
    color = np.zeros((OPTICS.height, OPTICS.width, 3), np.uint8)
    return RgbdFrame(0.0, 1, color, depth.astype(np.float32), OPTICS)


def ceiling(seen, x, y):
    row, col = (int((v - o) // RESOLUTION_M) for v, o in ((y, seen.origin[1]), (x, seen.origin[0])))
    return float(seen.ceiling_m[row, col])


def box(x, y, half, height):
    return (x - half, y - half, 0.0), (x + half, y + half, height)


@pytest.mark.parametrize("height", [0.05, 0.15, 0.25, 0.33])
def test_a_box_is_as_high_as_it_is_and_its_shadow_as_high_as_the_ray_over_it(height):
    seen = build_clearance_map(frame_of(box(-0.55, 0.05, 0.03, height)), CAMERA, 0.0, ())
    assert height <= ceiling(seen, -0.55, 0.05) <= height + ROUNDING_M
    assert ceiling(seen, -0.55, -0.10) == 0
    # The ray over the far edge of the top, on the line away from the camera.
    for behind in (0.02, 0.05, 0.08):
        share = (0.28 + behind) / 0.28
        x, y = -0.8 + 0.28 * share, 0.05 * share
        bound = EYE_M - (EYE_M - height) * share
        assert ceiling(seen, x, y) <= max(bound, 0.0) + 2 * ROUNDING_M
    # Everything that the box hides is bounded from above; nothing is forgotten behind it.
    assert ceiling(seen, -0.51, 0.05) >= 0.8 * (EYE_M - (EYE_M - height) * 0.29 / 0.28) - 0.02


def test_what_reaches_out_of_the_picture_may_have_any_height():
    seen = build_clearance_map(frame_of(box(-0.35, 0.0, 0.03, 0.6)), CAMERA, 0.0, ())
    assert ceiling(seen, -0.36, 0.0) >= EYE_M
    _, _, height, open_top = seen.tallest_near(-0.36, 0.0, 0.1, 0.0)
    assert open_top
    assert height >= EYE_M
    assert ceiling(seen, -0.36, 0.15) == 0


def test_what_the_camera_does_not_look_at_is_as_tall_as_a_block_and_the_base_stands_free():
    seen = build_clearance_map(frame_of(), CAMERA, 0.0, ())
    assert not seen.looks_at(-0.5, 0.6)
    far = np.array([[-0.5, 0.9, 0.2], [-0.1, 0.05, 0.13]])
    gaps = seen.gaps(far, np.array([0.05, 0.06]), 0.0, 0.1)
    assert gaps[0] == pytest.approx(0.2 - TALLEST_BLOCK_M - 0.05)
    assert gaps[1] == 0.1


def test_a_patch_without_returns_hides_no_more_than_what_fits_in_its_outline():
    frame = frame_of()
    frame.depth_m[100:130, 150:170] = 0
    seen = build_clearance_map(frame, CAMERA, 0.0, ())
    hidden = seen.ceiling_m[seen.looked_at]
    assert 0.05 < hidden.max() < 0.30
    # Single pixels without returns hide nothing.
    frame = frame_of()
    frame.depth_m[::7, ::5] = 0
    assert build_clearance_map(frame, CAMERA, 0.0, ()).ceiling_m[seen.looked_at].max() == 0


def test_furniture_is_followed_from_its_top_and_own_pixels_are_not_looked_through():
    bin_box = KeepOut(name="bin", x=(-0.6, -0.5), y=(0.1, 0.2), z=(0.0, 0.12))
    frame = frame_of(box(-0.55, 0.15, 0.05, 0.12))
    assert ceiling(build_clearance_map(frame, CAMERA, 0.0, (bin_box,)), -0.55, 0.15) == 0
    own = np.zeros(frame.depth_m.shape, np.bool_)
    own[:, :160] = True
    seen = build_clearance_map(frame, CAMERA, 0.0, (), own)
    assert not seen.looks_at(-0.55, 0.15)
    assert ceiling(seen, -0.55, 0.15) == pytest.approx(TALLEST_BLOCK_M)


def test_gaps_are_those_to_the_nearest_column():
    seen = build_clearance_map(frame_of(box(-0.55, 0.0, 0.04, 0.20)), CAMERA, 0.0, ())
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.7, -0.2, 0.02), (-0.3, 0.2, 0.4), (40, 3))
    gaps = seen.gaps(points, np.full(40, 0.02), 0.0, 0.1)
    rows, cols = np.nonzero(seen.ceiling_m)
    low = np.column_stack([cols, rows]) * RESOLUTION_M + seen.origin
    across = np.linalg.norm(
        np.maximum(0, np.maximum(low - points[:, None, :2], points[:, None, :2] - low - RESOLUTION_M)), axis=-1
    )
    up = np.maximum(0, points[:, 2:] - seen.ceiling_m[rows, cols])
    true = np.minimum(0.1, np.hypot(across, up).min(axis=1) - 0.02)
    # Never more than the truth, and less only by the rounding of heights and cells.
    assert (gaps <= true + 1e-6).all()
    assert (gaps >= true - 0.03).all()
    # Columns that end lower than 0.3 m do not count, if one says so.
    assert (seen.gaps(points, np.full(40, 0.02), 0.3, 0.1) == 0.1).all()
