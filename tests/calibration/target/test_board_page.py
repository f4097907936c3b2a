import re

import cv2
import numpy as np
import pytest

from calibration.target.board_page import save_page
from calibration.target.detection import Detector
from calibration.target.held_board import bolted_to_flange
from robotcell.errors import ConfigError, StorageError
from robotcell.geometry import rg2
from robotcell.geometry.transforms import check_transform, transform_points
from robotcell.perception.board_plate import DEFAULT_BOARD, MARGIN_M, draw_plate, held_by_gripper, plate_corners


def test_the_drawn_board_has_its_corners_where_the_layout_says():
    px_per_mm = 4
    plate = draw_plate(DEFAULT_BOARD, px_per_mm)
    found = Detector(DEFAULT_BOARD).detect(cv2.cvtColor(plate, cv2.COLOR_GRAY2RGB))
    assert found.refused == ""
    board = DEFAULT_BOARD.corners()
    assert set(found.corners.ids) == set(board)
    places = np.array([board[int(i)][:2] for i in found.corners.ids])
    # The edge of a square lies between two pixels, half a pixel before the centre of the next one.
    np.testing.assert_allclose(found.corners.px, 1000 * px_per_mm * (places + MARGIN_M) - 0.5, atol=0.15)


@pytest.mark.parametrize(("squares", "paper", "size"), [((7, 5), "A4", (297, 210)), ((10, 7), "A3", (420, 297))])
def test_the_page_is_to_scale(tmp_path, squares, paper, size):
    board = DEFAULT_BOARD.model_copy(update={"squares_x": squares[0], "squares_y": squares[1]})
    assert save_page(board, tmp_path / "board.pdf") == paper
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "board.pdf").read_bytes())
    assert box is not None
    # Points of 1/72 inch.
    np.testing.assert_allclose([float(v) * 25.4 / 72 for v in box.groups()], size, atol=0.01)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"squares_x": 15, "squares_y": 11, "square_m": 0.02, "marker_m": 0.014}, "need 82 markers"),
        ({"dictionary": "DICT_NONE"}, "no dictionary DICT_NONE"),
        ({"square_m": 0.08}, "does not fit on A3"),
    ],
)
def test_a_board_that_cannot_be_printed_is_refused(tmp_path, change, words):
    with pytest.raises(ConfigError, match=words):
        save_page(DEFAULT_BOARD.model_copy(update=change), tmp_path / "board.pdf")


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(StorageError, match="nowhere"):
        save_page(DEFAULT_BOARD, tmp_path / "nowhere" / "board.pdf")


def test_the_gripper_holds_the_plate_beyond_its_tips_printed_side_out():
    T = check_transform(held_by_gripper(DEFAULT_BOARD), "T")
    corners = transform_points(T, plate_corners(DEFAULT_BOARD))
    # The whole plate lies before the finger tips, in the plane of the approach axis, in the middle of the fingers.
    assert corners[:, 2].min() > rg2.CLOSED_LENGTH_M
    assert np.ptp(corners[:, 0]) < 1e-12
    assert abs(corners[:, 1].mean()) < 1e-12
    # Seen from where the board's z points away from, the rows run to the right.
    np.testing.assert_allclose(T[:3, 2], (1, 0, 0), atol=1e-12)


def test_a_bolted_plate_faces_away_from_the_flange():
    T = check_transform(bolted_to_flange(DEFAULT_BOARD), "T")
    np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(transform_points(T, plate_corners(DEFAULT_BOARD)).mean(axis=0)[:2], 0, atol=1e-12)
