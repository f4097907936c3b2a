import cv2
import numpy as np
import pytest

from calibration.solve.views import Corners
from calibration.target.detection import Detector, average, draw
from robotcell.perception.board_plate import DEFAULT_BOARD, draw_plate


@pytest.fixture(scope="module")
def picture():
    """The board on grey, a little turned, and the map from the plate's pixels to the picture's."""
    plate = draw_plate(DEFAULT_BOARD, 2)
    turn = np.array([[0.95, 0.2, 60.0], [-0.18, 0.9, 160.0], [1e-4, -5e-5, 1.0]])
    grey = cv2.warpPerspective(plate, turn, (640, 480), flags=cv2.INTER_AREA, borderValue=90)
    return cv2.cvtColor(cv2.GaussianBlur(grey, (3, 3), 0.8), cv2.COLOR_GRAY2RGB), turn


def test_corners_are_found_where_they_are(picture):
    image, turn = picture
    corners = Detector(DEFAULT_BOARD).detect(image).corners
    board = DEFAULT_BOARD.corners()
    assert len(corners.ids) == len(board)
    places = np.array([[2000 * (board[int(i)][k] + 0.01) - 0.5 for k in (0, 1)] for i in corners.ids])
    expected = cv2.perspectiveTransform(places[None], turn)[0]
    assert np.abs(corners.px - expected).max() < 0.3
    assert np.abs((corners.px - expected).mean(axis=0)).max() < 0.05


def test_an_image_without_a_board_is_refused():
    found = Detector(DEFAULT_BOARD).detect(np.full((480, 640, 3), 90, np.uint8))
    assert "not found" in found.refused
    assert len(found.corners.ids) == 0


def test_a_few_corners_are_refused_with_their_number(picture):
    image = picture[0].copy()
    image[:, 230:] = 90
    found = Detector(DEFAULT_BOARD).detect(image)
    assert 0 < len(found.corners.ids) < 8
    assert f"{len(found.corners.ids)} corners" in found.refused


def test_corners_on_two_lines_are_refused():
    ids = np.arange(12)  # two rows of six
    assert "2 line(s)" in Detector(DEFAULT_BOARD).refuse(Corners(ids, np.zeros((12, 2))))


def test_the_mean_of_frames_keeps_what_all_show_and_tells_how_far_it_wanders():
    first = Corners(np.array([3, 1, 7]), np.array([[10.0, 10.0], [20.0, 10.0], [30.0, 10.0]]))
    second = Corners(np.array([7, 3]), np.array([[30.2, 10.0], [10.0, 10.4]]))
    mean, wander = average([first, second])
    assert mean.ids.tolist() == [3, 7]
    np.testing.assert_allclose(mean.px, [[10.0, 10.2], [30.1, 10.0]])
    assert wander == pytest.approx(0.2)


def test_the_picture_shows_the_corners_in_another_colour_when_they_are_refused(picture):
    image, _ = picture
    detector = Detector(DEFAULT_BOARD)
    good = detector.detect(image)
    drawn = draw(image, good)
    assert drawn.shape == image.shape
    assert (drawn != image).any()
    assert (draw(image, type(good)(good.corners, "blurred")) != drawn).any()
