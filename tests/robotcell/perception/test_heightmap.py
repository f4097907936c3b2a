import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.config import CameraMount, Workspace
from robotcell.geometry.transforms import look_at, make_transform, rotation_z
from robotcell.interfaces import Intrinsics, RgbdFrame
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.heightmap import BAND_M, build_heightmap
from tests.robotcell.maps import heightmap

# Single precision at a metre's distance, several roundings deep.
TOLERANCE_M = 5e-6


def frame_of(depth_m, intrinsics, color=None):
    if color is None:
        number = np.arange(depth_m.size, dtype=np.uint32).reshape(depth_m.shape) + 1
        color = np.stack([number & 255, number >> 8 & 255, number >> 16], axis=-1).astype(np.uint8)
    return RgbdFrame(t=3.5, number=7, color=color, depth_m=depth_m.astype(np.float32), intrinsics=intrinsics)


def points_of(frame, T_base_camera):
    """(H, W, 3) points in the base frame, in double precision."""
    k = frame.intrinsics
    v, u = np.mgrid[: k.height, : k.width]
    directions = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    depth = frame.depth_m.astype(np.float64)[..., None]
    return depth * directions @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]


def depth_of_plane(intrinsics, T_base_camera, height_m, x_slope=0.0):
    """(H, W) depth at which each pixel meets the plane z = height_m + x_slope * (x + 0.5)."""
    ones = frame_of(np.ones((intrinsics.height, intrinsics.width)), intrinsics)
    rays = points_of(ones, T_base_camera) - T_base_camera[:3, 3]
    eye = T_base_camera[:3, 3]
    return (height_m + x_slope * (eye[0] + 0.5) - eye[2]) / (rays[..., 2] - x_slope * rays[..., 0])


@st.composite
def scenes(draw):
    """A random view of random points in and around a random workspace."""
    x, y = draw(st.floats(-0.7, 0.4)), draw(st.floats(-0.5, 0.5))
    size = draw(st.tuples(st.floats(0.02, 0.4), st.floats(0.02, 0.4)))
    workspace = Workspace(
        x=(x, x + size[0]), y=(y, y + size[1]), resolution_m=draw(st.sampled_from([0.002, 0.005, 0.01]))
    )
    table = draw(st.floats(-0.3, 0.3))
    aim = np.array([x + size[0] / 2, y + size[1] / 2, table])
    eye = np.add(aim, (draw(st.floats(-0.6, 0.6)), draw(st.floats(-0.6, 0.6)), draw(st.floats(0.05, 1.0))))
    roll = make_transform(rotation_z(draw(st.floats(-np.pi, np.pi))), (0, 0, 0))
    T_base_camera = look_at(eye, aim) @ roll
    focal = draw(st.floats(20, 120))
    intrinsics = Intrinsics(32, 24, focal, focal * 1.02, 15.2, 12.6)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    depth = rng.normal(np.linalg.norm(eye - aim), 0.1, (24, 32))
    depth[rng.random(depth.shape) < 0.2] = 0
    return workspace, table, T_base_camera, frame_of(depth, intrinsics), rng.random(depth.shape) < 0.5


@settings(max_examples=30)
@given(scenes())
def test_each_cell_is_its_highest_return(scene):
    workspace, table, T_base_camera, frame, image_mask = scene
    result = build_heightmap(frame, CalibratedCamera(T_base_camera), workspace, table, {"mask": image_mask})

    points = points_of(frame, T_base_camera)[frame.depth_m > 0]
    colors, masked = frame.color[frame.depth_m > 0], image_mask[frame.depth_m > 0]
    height = points[:, 2] - table
    assert result.height_m.shape == workspace.shape
    for row, col in np.ndindex(*workspace.shape):
        x, y = workspace.position(row, col)
        off = np.maximum(abs(points[:, 0] - x), abs(points[:, 1] - y)) - workspace.resolution_m / 2
        off = np.max([off, BAND_M[0] - height, height - BAND_M[1]], axis=0)
        surely, perhaps = off < -TOLERANCE_M, off < TOLERANCE_M
        here = result.height_m[row, col]
        if surely.any():
            assert here >= height[surely].max() - TOLERANCE_M
        if np.isnan(here):
            assert not result.color[row, col].any()
            assert not result.masks["mask"][row, col]
        else:
            source = perhaps & (abs(height - here) < TOLERANCE_M)
            same = (colors[source] == result.color[row, col]).all(axis=1)
            assert same.any()
            assert result.masks["mask"][row, col] in masked[source][same]
    assert result.coverage == pytest.approx(np.isfinite(result.height_m).mean())
    assert result.t == frame.t


@given(offset=st.floats(-0.02, 0.02), slope=st.floats(-0.03, 0.03), covered=st.floats(0, 0.3), seed=st.integers(0, 99))
@settings(max_examples=20)
def test_the_table_is_measured_under_noise_and_objects(offset, slope, covered, seed):
    intrinsics, T_base_camera = Intrinsics(320, 240, 309, 309, 160, 120), CameraMount().pose()
    rng = np.random.default_rng(seed)
    tops = depth_of_plane(intrinsics, T_base_camera, offset + 0.05)
    depth = depth_of_plane(intrinsics, T_base_camera, offset, slope)
    depth = np.where(np.arange(240)[:, None] < covered * 240, tops, depth)
    depth += rng.normal(0, 0.002, depth.shape)
    table = build_heightmap(frame_of(depth, intrinsics), CalibratedCamera(T_base_camera), Workspace(), 0.0).table
    assert table is not None
    assert table.offset_m == pytest.approx(offset, abs=4e-4)
    assert table.tilt_rad == pytest.approx(np.arctan(abs(slope)), abs=2e-3)
    assert 0.0005 < table.rms_m < 0.004


def test_a_frame_without_returns_shows_nothing():
    intrinsics = Intrinsics(64, 48, 60, 60, 32, 24)
    depth = np.zeros((48, 64), np.float32)
    depth[0, :3] = np.nan, np.inf, -1.0
    result = build_heightmap(frame_of(depth, intrinsics), CalibratedCamera(CameraMount().pose()), Workspace(), 0.0)
    assert np.isnan(result.height_m).all()
    assert result.coverage == 0
    assert result.table is None
    assert not result.filled_m.any()


def test_what_is_over_the_cap_leaves_the_table_below_unknown():
    intrinsics, T_base_camera = Intrinsics(64, 48, 60, 60, 32, 24), CameraMount().pose()
    depth = depth_of_plane(intrinsics, T_base_camera, BAND_M[1] + 0.05)
    assert build_heightmap(frame_of(depth, intrinsics), CalibratedCamera(T_base_camera), Workspace(), 0.0).coverage == 0


def test_images_and_poses_that_do_not_fit_are_refused():
    intrinsics = Intrinsics(64, 48, 60, 60, 32, 24)
    frame = frame_of(np.ones((48, 64)), intrinsics)
    with pytest.raises(ValueError, match=r"image 'goal' is \(64, 48\)"):
        build_heightmap(
            frame, CalibratedCamera(CameraMount().pose()), Workspace(), 0.0, {"goal": np.zeros((64, 48), bool)}
        )
    with pytest.raises(ValueError, match="mirrored"):
        CalibratedCamera(np.diag([1.0, 1.0, -1.0, 1.0]))


def test_filling_closes_gaps_and_leaves_shadows_at_the_table():
    heights = np.zeros(Workspace().shape, np.float32)
    heights[50:75, 50:75] = 0.05
    heights[60:62, 60:62] = np.nan  # drop-out on the object
    heights[120, 120] = np.nan  # and on the table
    heights[50:75, 75:90] = np.nan  # the object's shadow
    seen = heightmap(heights)
    filled = seen.filled_m
    with pytest.raises(ValueError, match="read-only"):
        filled[0, 0] = 9.0  # everybody reads the same
    assert np.isnan(seen.closed_m[52:73, 76:90]).all()
    assert not seen.filled_m[0, 0]
    with pytest.raises(ValueError, match="read-only"):
        seen.closed_m[0, 0] = 9.0
    assert np.isfinite(filled).all()
    assert (filled[50:75, 50:75] == np.float32(0.05)).all()
    assert filled[120, 120] == 0
    assert (filled[52:73, 76:90] == 0).all()
