import cv2
import numpy as np
import pytest

from robotcell.config import CameraMount, load_config
from robotcell.errors import ConfigError, ConnectionLost
from robotcell.geometry.transforms import invert_transform, look_at, transform_points
from sim_twin.d415.noise import WARM_UP_FRAMES
from sim_twin.d415.rays import ray_directions
from sim_twin.devices.camera import TwinCamera
from sim_twin.options import NoiseOptions, TwinOptions
from sim_twin.world.world import World
from tests.sim_twin.boxes import Box, BoxWorld, box_at, table_with_blocks

CLEAN = NoiseOptions(**dict.fromkeys(NoiseOptions.model_fields, False))
RED = np.array([255, 87, 89], np.uint8)


def camera_above(height, resolution="640x480", noise=CLEAN, seed=1, world=None, **options):
    """A camera that looks straight down from `height` on a table with a red block of 50 mm."""
    world = world or BoxWorld([Box((4, 4, 0.1)), Box((0.05,) * 3, RED)], [box_at(0, 0, -0.05), box_at(0, 0, 0.025)])
    mount = CameraMount(resolution=resolution, position=(0, 0, height), look_at=(0, 0, 0))
    return TwinCamera(world, mount, TwinOptions(noise=noise, seed=seed, **options)), world


@pytest.mark.parametrize(("resolution", "shape"), [("640x480", (480, 640)), ("1280x720", (720, 1280))])
def test_a_clean_frame_shows_the_scene_where_it_is(resolution, shape):
    camera, _ = camera_above(0.9, resolution)
    with camera:
        frame = camera.read()
    assert frame.color.shape == (*shape, 3)
    assert frame.color.dtype == np.uint8
    assert frame.depth_m.shape == shape
    assert frame.depth_m.dtype == np.float32
    points = transform_points(
        look_at((0, 0, 0.9), (0, 0, 0)), ray_directions(frame.intrinsics) * frame.depth_m[..., None]
    )
    on_block = (abs(points[..., :2]) < 0.024).all(axis=2)
    off_block = (abs(points[..., :2]) > 0.05).any(axis=2)
    np.testing.assert_allclose(points[on_block][:, 2], 0.05, atol=1e-5)
    np.testing.assert_allclose(points[off_block][:, 2], 0.0, atol=1e-5)
    np.testing.assert_allclose(frame.color[on_block] / RED, frame.color[on_block][0, 0] / RED[0], atol=0.02)
    assert np.ptp(frame.color[off_block]) == 0


def test_faces_that_turn_away_from_the_lamps_are_darker():
    world = BoxWorld([Box((0.1, 0.1, 0.1), RED)], [box_at(0, 0, 0.05)])
    mount = CameraMount(position=(0.5, 0, 0.5), look_at=(0, 0, 0.05))
    with TwinCamera(world, mount, TwinOptions(noise=CLEAN, seed=1)) as camera:
        frame = camera.read()
        _, visual = camera.render_truth()
    reds = np.unique(frame.color[visual == 0][:, 0])
    assert len(reds) == 2
    assert reds[0] < 0.8 * reds[1]
    assert (frame.color[visual == -1] == 0).all()


@pytest.mark.parametrize(("resolution", "seen"), [("640x480", True), ("1280x720", False)])
def test_nothing_is_measured_below_the_shortest_range(resolution, seen):
    camera, _ = camera_above(0.42, resolution)
    with camera:
        assert camera.read().depth_m.any() == seen
        assert camera.render_truth()[0].all()


def test_frames_come_at_30_hz_of_simulated_time():
    camera, world = camera_above(0.9)
    with camera:
        frames = [camera.read(), camera.read()]
        world.step(20)
        frames.append(camera.read())
    assert frames[1].t - frames[0].t == pytest.approx(1 / 30)
    assert [frame.number - frames[0].number for frame in frames] == [0, 1, 4]
    assert frames[2].t == world.time_s


def test_connecting_waits_until_exposure_has_settled():
    camera, world = camera_above(0.9, noise=CLEAN.model_copy(update={"warm_up": True}))
    clean, _ = camera_above(0.9)
    with camera, clean:
        assert world.time_s == pytest.approx(WARM_UP_FRAMES / 30)
        settled, right = camera.read().color.astype(float), clean.read().color.astype(float)
    assert abs(settled - right).max() <= 1


def test_a_seed_gives_the_same_frames_again():
    images = []
    for seed in (1, 1, 2):
        camera = TwinCamera(table_with_blocks(), CameraMount(), TwinOptions(seed=seed))
        with camera:
            images.append(camera.read())
    np.testing.assert_array_equal(images[0].depth_m, images[1].depth_m)
    np.testing.assert_array_equal(images[0].color, images[1].color)
    assert (images[0].depth_m != images[2].depth_m).mean() > 0.3


def test_the_truth_takes_no_time_and_has_no_noise():
    camera, world = camera_above(0.9, noise=NoiseOptions())
    with camera:
        before = world.time_s
        depth, visual = camera.render_truth()
        assert world.time_s == before
    assert set(np.unique(visual)) == {0, 1}
    np.testing.assert_allclose(depth[visual == 0], 0.9, atol=1e-5)


def test_what_is_added_to_the_world_is_seen():
    camera, world = camera_above(0.9)
    with camera:
        camera.read()
        world.boxes = (*world.boxes, Box((0.05,) * 3))
        world.poses = np.array([*world.poses, box_at(0.2, 0, 0.025)])
        camera.read()
        assert set(np.unique(camera.render_truth()[1])) == {0, 1, 2}


def test_a_camera_that_is_not_connected_says_so():
    camera, world = camera_above(0.9)
    for use in (camera.read, camera.render_truth):
        with pytest.raises(ConnectionLost, match="connect"):
            use()
    with camera:
        camera.connect()
        assert world.devices == [camera]
    camera.close()
    assert world.devices == []
    with pytest.raises(ConnectionLost):
        camera.read()


@pytest.mark.parametrize("resolution", ["640x480", "1280x720"])
def test_in_the_twin_things_are_seen_where_the_world_has_them(resolution):
    config = load_config(overrides={"camera.resolution": resolution, "backend.options.seed": 4})
    world = World(config, TwinOptions(seed=4))
    with TwinCamera(world, config.camera, TwinOptions(seed=4)) as camera:
        frame = camera.read()
        depth, visual = camera.render_truth()
        seen, objects = world.visuals(), world.objects()
    rays = ray_directions(frame.intrinsics)
    points = transform_points(config.camera.pose(), rays * frame.depth_m[..., None])
    measured = frame.depth_m > 0
    table = np.isin(visual, [k for k, v in enumerate(seen) if v.kind == "table"])
    edge = cv2.dilate(table.astype(np.uint8), np.ones((9, 9))) != cv2.erode(table.astype(np.uint8), np.ones((9, 9)))
    x, y = points[..., 0], points[..., 1]
    workspace = (x > -0.724) & (x < -0.276) & (abs(y) < 0.224)
    heights = points[table & ~edge & measured & workspace][:, 2]
    assert abs(heights.mean()) < 0.0005
    assert heights.std() < 0.0025
    assert measured[workspace & table & ~edge].mean() > 0.98
    optics = frame.intrinsics
    v, u = np.indices(depth.shape)
    in_camera = np.stack([(u - optics.cx) / optics.fx, (v - optics.cy) / optics.fy, np.ones_like(u)], axis=2)
    exact = transform_points(config.camera.pose(), in_camera * depth[..., None])
    checked = 0
    for index, (item, T_base_object) in enumerate(objects):
        pixels = np.isin(visual, [k for k, v in enumerate(seen) if v.object_index == index])
        corners = item.shape.mesh.vertices[item.shape.mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        surface = transform_points(invert_transform(T_base_object), exact[pixels])
        # Every pixel of an object lies in a plane of its faces, and not outside its bounding box.
        heights = surface @ normals.T - np.einsum("mi,mi->m", normals, corners[:, 0])
        low, high = item.shape.mesh.vertices.min(axis=0), item.shape.mesh.vertices.max(axis=0)
        assert (np.abs(heights).min(axis=1) < 0.002).all()
        assert ((surface > low - 0.002) & (surface < high + 0.002)).all()
        checked += len(surface)
    assert checked > 1000


def test_a_world_that_cannot_be_built_leaves_nothing_attached():
    world = World(load_config(), TwinOptions(scene="no such scene"))
    camera = TwinCamera(world, CameraMount(), TwinOptions(noise=CLEAN, seed=1))
    with pytest.raises(ConfigError):
        camera.connect()
    with pytest.raises(ConnectionLost):
        camera.read()


def test_a_camera_reports_other_intrinsics_than_it_sees_with():
    (true, _), (wrong, _) = (
        camera_above(0.9, **options)
        for options in ({}, {"intrinsics_error": {"focal": 0.01, "cx_px": 3.0, "cy_px": -2.0}})
    )
    with true, wrong:
        seen, reported = true.read(), wrong.read()
    np.testing.assert_array_equal(reported.color, seen.color)
    np.testing.assert_array_equal(reported.depth_m, seen.depth_m)
    a, b = seen.intrinsics, reported.intrinsics
    assert (b.fx, b.fy) == (pytest.approx(1.01 * a.fx), pytest.approx(1.01 * a.fy))
    assert (b.cx, b.cy) == (a.cx + 3.0, a.cy - 2.0)
    assert (b.width, b.height) == (a.width, a.height)


def test_a_camera_delivers_depth_that_is_scaled_and_offset():
    hole = BoxWorld([Box((0.2, 0.2, 0.1), RED)], [box_at(0, 0, -0.05)])
    (true, _), (wrong, _) = (
        camera_above(0.9, world=hole, **options)
        for options in ({}, {"depth_error": {"scale": 1.02, "offset_m": -0.004}})
    )
    with true, wrong:
        seen, off = true.read().depth_m, wrong.read().depth_m
        truth, _ = wrong.render_truth()
    there = seen > 0
    assert 0 < there.mean() < 1
    np.testing.assert_allclose(off[there], 1.02 * seen[there] - 0.004, atol=1e-6)
    # Nothing stays nothing, and the truth stays the truth.
    assert (off[~there] == 0).all()
    np.testing.assert_allclose(truth[there], seen[there], atol=1e-6)
    assert off.dtype == np.float32
