import cv2
import numpy as np
import pytest

from robotcell.errors import CalibrationError
from robotcell.perception.tags import FAMILY, MAX_SHIFT_PX, check_tags, find_tags


def scene(shift=(0.0, 0.0), tags=((3, 100, 80), (11, 420, 300)), noise_seed=0):
    """An image (480, 640, 3) of tags at (id, left, top), as a camera sees it that has moved by some pixels."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
    image = np.full((480, 640), 110, np.uint8)
    for number, left, top in tags:
        sheet = np.pad(cv2.aruco.generateImageMarker(dictionary, number, 64), 14, constant_values=230)
        image[top : top + len(sheet), left : left + len(sheet)] = sheet
    moved = cv2.warpAffine(
        image, np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float64), (640, 480), borderValue=110
    )
    noisy = cv2.GaussianBlur(moved, (3, 3), 0.8) + np.random.default_rng(noise_seed).normal(0, 2, moved.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)


def test_tags_are_found_with_their_corners():
    tags = find_tags(scene())
    assert [tag.id for tag in tags] == [3, 11]
    np.testing.assert_allclose(tags[0].corners_px[0], (113.5, 93.5), atol=0.3)


def test_a_camera_that_stands_still_passes_under_noise():
    tags = find_tags(scene())
    for seed in (1, 2, 3):
        check_tags(scene(noise_seed=seed), tags)


@pytest.mark.parametrize("shift", [(2.0, 0.0), (-1.4, 1.4), (0.0, 12.0)])
def test_a_camera_that_has_moved_is_noticed(shift):
    assert np.hypot(*shift) > MAX_SHIFT_PX
    with pytest.raises(CalibrationError, match=r"tag 3 has moved by .*calibrate again"):
        check_tags(scene(shift), find_tags(scene()))


def test_a_tag_that_is_gone_is_named_with_its_place():
    tags = find_tags(scene())
    with pytest.raises(CalibrationError, match="tag 11 is not seen near u 46"):
        check_tags(scene(tags=((3, 100, 80),)), tags)


def test_a_camera_that_looks_elsewhere_does_not_see_the_tag():
    with pytest.raises(CalibrationError, match="not seen"):
        check_tags(scene((200.0, 0.0)), find_tags(scene()))


def test_without_tags_there_is_nothing_to_check():
    check_tags(scene(tags=()), ())
