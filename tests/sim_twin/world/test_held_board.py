"""What the twin's camera makes of printed things: corners must be where they are, or no calibration can be right."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.target.detection import Detector
from robotcell.config import CameraMount, CellConfig
from robotcell.config.calibration_file import FixedTag
from robotcell.errors import CalibrationError
from robotcell.geometry.transforms import invert_transform, make_transform, transform_points
from robotcell.perception.board_plate import DEFAULT_BOARD, held_by_gripper
from robotcell.perception.tags import check_tags, find_tags
from sim_twin.d415.renderer import Renderer
from sim_twin.options import TwinOptions
from sim_twin.world.fixed_tag import TAG_ID, tag_visual
from sim_twin.world.held_board import T_flange_board, board_visuals

SEED = 4


def look_at_board(mount, T_camera_board, frame):
    """The image of the held board alone, and its corners (24, 2) by id as they should be."""
    T_base_flange = mount.nominal() @ T_camera_board @ invert_transform(T_flange_board(SEED))
    renderer = Renderer(board_visuals(SEED), mount, TwinOptions())
    hits = renderer.cast(np.stack([T_base_flange] * 2))
    points = transform_points(T_camera_board, np.array(list(DEFAULT_BOARD.corners().values())))
    optics = renderer.intrinsics
    px = points[:, :2] / points[:, 2:] * (optics.fx, optics.fy) + (optics.cx, optics.cy)
    return renderer.measured_color(renderer.color(hits), frame, 0.0, 100), px


@pytest.mark.parametrize("resolution", ["640x480", "1280x720"])
def test_corners_are_seen_without_bias(resolution):
    mount = CameraMount(resolution=resolution)
    rng = np.random.default_rng(0)
    off = []
    for frame in range(5):
        R = Rotation.from_rotvec([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3)]).as_matrix()
        middle = np.array([rng.uniform(-0.08, 0.08), rng.uniform(-0.05, 0.05), rng.uniform(0.5, 0.75)])
        image, px = look_at_board(mount, make_transform(R, middle - R @ (0.105, 0.075, 0)), frame)
        found = Detector(DEFAULT_BOARD).detect(image)
        assert found.refused == ""
        off.append(found.corners.px - px[found.corners.ids])
    off = np.vstack(off)
    assert len(off) > 100
    assert np.abs(off.mean(axis=0)).max() < 0.02
    assert np.sqrt((off**2).mean()) < 0.10


def test_a_board_seen_from_behind_is_blank():
    T = make_transform(np.diag([1.0, -1.0, -1.0]), (-0.1, 0.1, 0.6))
    image, _ = look_at_board(CameraMount(), T, 0)
    assert "not found" in Detector(DEFAULT_BOARD).detect(image).refused


def test_each_seed_holds_the_board_a_little_differently():
    nominal, held = held_by_gripper(DEFAULT_BOARD), [T_flange_board(seed) for seed in range(5)]
    for T in held:
        assert 0 < np.linalg.norm(T[:3, 3] - nominal[:3, 3]) < 0.015
    assert len({T.tobytes() for T in held}) == 5
    np.testing.assert_array_equal(T_flange_board(3), held[3])


def test_the_camera_stands_where_it_was_put_whatever_is_believed(tmp_path):
    mount = CameraMount()
    options = TwinOptions(camera_offset=(0.01, 0.0, -0.02, 0.0, 0.0, 0.1))
    T = options.camera_pose(mount)
    np.testing.assert_allclose(T[:3, 3] - mount.nominal()[:3, 3], (0.01, 0.0, -0.02), atol=1e-12)
    turned = Rotation.from_matrix(T[:3, :3] @ mount.nominal()[:3, :3].T).as_rotvec()
    np.testing.assert_allclose(turned, (0.0, 0.0, 0.1), atol=1e-12)


def see_tag(offset_m):
    config = CellConfig()
    options = TwinOptions(camera_offset=(offset_m, 0, 0, 0, 0, 0))
    renderer = Renderer([tag_visual(config)], config.camera, options)
    return renderer.measured_color(renderer.color(renderer.cast(np.eye(4)[None])), 1, 0.0, 100)


def test_a_camera_that_moved_by_half_a_centimetre_is_noticed_by_the_tag():
    tags = find_tags(see_tag(0.0))
    assert [tag.id for tag in tags] == [TAG_ID]
    assert isinstance(tags[0], FixedTag)
    check_tags(see_tag(0.0), tags)
    with pytest.raises(CalibrationError, match="has moved"):
        check_tags(see_tag(0.005), tags)
