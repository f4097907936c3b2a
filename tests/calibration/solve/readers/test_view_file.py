from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.solve.pipeline import solve
from calibration.solve.readers.corner_record import parse_pose
from calibration.solve.readers.view_file import read_file
from calibration.solve.se3 import exp
from robotcell.errors import ConfigError
from robotcell.geometry.transforms import make_transform
from tests.calibration.synthetic import BOARD, as_poses, make_views, to_json

if TYPE_CHECKING:
    from pathlib import Path


def corners_file(views: Any) -> dict[str, Any]:
    """The content of a corners.json of views."""
    return {
        "mount": views.mount,
        "camera": {"width": 1280, "height": 720, "fx": 926, "fy": 926, "cx": 640, "cy": 360, "dist": [0, 0, 0, 0, 0]},
        "board": BOARD.model_dump(),
        "views": [
            {"name": name, "T_base_flange": to_json(T), "ids": to_json(view.ids), "corners_px": to_json(view.px)}
            for name, T, view in zip(views.names, views.T_base_flange, views.corners, strict=True)
        ],
    }


def write(path: Path, values: Any) -> Path:
    path.write_text(json.dumps(values))
    return path


def test_pairs_are_read_as_they_are(tmp_path: Path) -> None:
    views, truth = make_views(0, 5)
    poses = as_poses(views, truth)
    pairs = [to_json(pair) for pair in zip(poses.T_base_flange, poses.T_camera_board, strict=True)]
    read = read_file(write(tmp_path / "pairs.json", pairs), "flange")
    assert read.mount == "flange"
    np.testing.assert_allclose(read.T_base_flange, poses.T_base_flange, atol=1e-12)
    np.testing.assert_allclose(read.T_camera_board, poses.T_camera_board, atol=1e-12)
    assert read.names[3] == "pair 3"


def test_corners_are_read_as_they_are(tmp_path: Path) -> None:
    views, _ = make_views(0, 5, mount="flange")
    read = read_file(write(tmp_path / "corners.json", corners_file(views)))
    assert (read.mount, read.names, read.board) == ("flange", views.names, BOARD)
    for theirs, ours in zip(read.corners, views.corners, strict=True):
        np.testing.assert_array_equal(theirs.ids, ours.ids)
        np.testing.assert_array_equal(theirs.px, ours.px)


def test_a_board_of_points_solves_as_well(tmp_path: Path) -> None:
    views, truth = make_views(0, 15, corner_px=0.1)
    values = corners_file(views) | {"board": {"points": {str(k): v for k, v in BOARD.corners().items()}}}
    solution = solve(read_file(write(tmp_path / "corners.json", values)))
    assert solution.accepted
    assert np.linalg.norm(solution.estimate.X[:3, 3] - truth.X[:3, 3]) < 0.001


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.integers(4, 8))
def test_printed_digits_are_good_enough(rotvec: list[float], digits: int) -> None:
    T = make_transform(exp(np.array(rotvec)), (0.1, 0.2, 0.3))
    read = parse_pose(np.round(T, digits).tolist(), "T")
    np.testing.assert_allclose(read[:3, :3] @ read[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(read, T, atol=10.0**-digits)


IDENTITY = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ("text", "neither a list of pose pairs nor an object with corners"),
        ([[IDENTITY]], "pair 0: not a list of two matrices"),
        ([[IDENTITY, IDENTITY], [IDENTITY, np.eye(3).tolist()]], r"pair 1: T_camera_board: has shape \(3, 3\)"),
        ([[IDENTITY, [["a"] * 4] * 4]], "pair 0: T_camera_board: not a 4x4 matrix of numbers"),
        ([[IDENTITY, [[1, 0], [0]]]], "pair 0: T_camera_board: not a 4x4 matrix of numbers"),
        ([[np.diag([2, 1, 1, 1]).tolist(), IDENTITY]], "pair 0: T_base_flange: not rigid"),
        ([[make_transform(np.eye(3), (1, 2, 3)).T.tolist(), IDENTITY]], "it looks transposed"),
        ({"mount": "fixed", "camera": {}}, "board, views: missing"),
    ],
)
def test_a_wrong_file_is_told_by_view_and_field(tmp_path: Path, values: Any, reason: str) -> None:
    path = write(tmp_path / "input.json", values)
    with pytest.raises(ConfigError, match=reason) as caught:
        read_file(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"mount": "wall"}, 'mount: \'wall\'; it is "fixed" or "flange"'),
        ({"camera": {"width": 1280}}, "camera: height: Field required"),
        ({"camera": {"width": 1280, "height": 720, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "dist": [0] * 8}}, "8 numbers"),
        ({"board": {"squares_x": 7}}, "board: squares_y: Field required"),
        ({"board": {"points": {"0": [0, 0]}}}, "board: points"),
        ({"views": {}}, "views: not a list"),
        ({"views": [3]}, "view 0: Input should be a valid dictionary"),
    ],
)
def test_a_wrong_part_of_a_corners_file_is_named(tmp_path: Path, change: dict[str, Any], reason: str) -> None:
    values = corners_file(make_views(0, 2)[0]) | change
    with pytest.raises(ConfigError) as caught:
        read_file(write(tmp_path / "corners.json", values))
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"ids": [1, 2]}, "2 ids and 24 corners_px"),
        ({"ids": [*range(23), 99]}, "ids: [99] are not on the board (24 corners)"),
        ({"ids": [0] * 24}, "an id appears twice"),
        ({"corners_px": [[5000.0, 1.0]] * 24}, "corners_px: outside the image of 1280x720"),
        ({"T_base_flange": np.zeros((4, 4)).tolist()}, "T_base_flange: the last row is"),
        ({"depth_m": [0.5]}, "24 ids and 1 depth_m"),
        ({"name": "view_000"}, "the name appears twice"),
        ({"pose": 1}, "pose: Extra inputs are not permitted"),
    ],
)
def test_a_wrong_view_is_named(tmp_path: Path, change: dict[str, Any], reason: str) -> None:
    values = corners_file(make_views(8, 2)[0])
    assert len(values["views"][1]["ids"]) == 24
    values["views"][1] |= change
    with pytest.raises(ConfigError) as caught:
        read_file(write(tmp_path / "corners.json", values))
    assert f"view {values['views'][1]['name']}" in str(caught.value)
    assert reason in str(caught.value)


def test_the_mount_of_the_file_stands(tmp_path: Path) -> None:
    path = write(tmp_path / "corners.json", corners_file(make_views(0, 2)[0]))
    with pytest.raises(ConfigError, match="mount is fixed in the file and flange on the command line"):
        read_file(path, "flange")


@pytest.mark.parametrize(("text", "reason"), [("[", "not a JSON file"), (None, "no such file")])
def test_a_file_that_cannot_be_read(tmp_path: Path, text: str | None, reason: str) -> None:
    path = tmp_path / "pairs.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        read_file(path)
