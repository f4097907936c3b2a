from __future__ import annotations

from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from calibration.collect.session import (
    add_view,
    create_session,
    image_path,
    load_header,
    load_records,
    read_session,
    read_views,
)
from calibration.solve.pipeline import solve
from robotcell.errors import ConfigError, StorageError
from tests.calibration.recorded import HEADER, record, write_session
from tests.calibration.solve.readers.test_view_file import corners_file, write
from tests.calibration.synthetic import make_views

if TYPE_CHECKING:
    from pathlib import Path


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (720, 1280, 3), dtype=np.uint8)


def test_a_session_gives_back_what_was_put_in(tmp_path: Path) -> None:
    views, _ = make_views(0, 3)
    create_session(tmp_path / "s", HEADER)
    depth = np.full((720, 1280), 0.8123, np.float32)
    depth[:10] = 0.0
    for i in (1, 0, 2):
        add_view(tmp_path / "s", record(views, i), picture(), depth)
    assert load_header(tmp_path / "s") == HEADER
    assert [view.name for view in load_records(tmp_path / "s")] == list(views.names)
    read = read_session(tmp_path / "s")
    assert read.date == datetime(2026, 3, 1, 12, 2, tzinfo=timezone.utc)
    np.testing.assert_allclose(read.T_base_flange, views.T_base_flange, atol=1e-12)
    np.testing.assert_array_equal(read.corners[2].px, views.corners[2].px)
    np.testing.assert_array_equal(np.asarray(Image.open(image_path(tmp_path / "s", "view_001"))), picture())
    stored = np.asarray(Image.open(tmp_path / "s" / "views" / "view_001.depth.png"))
    np.testing.assert_allclose(stored * 1e-4, depth, atol=5.1e-5)


def test_a_view_that_was_cut_short_is_not_there(tmp_path: Path) -> None:
    """The record is written last: an image alone, or half a record, is no view."""
    views, _ = make_views(0, 2)
    create_session(tmp_path, HEADER)
    add_view(tmp_path, record(views, 0), picture(), None)
    (tmp_path / "views" / "view_001.png").write_bytes(b"")
    (tmp_path / "views" / "view_001.json.part").write_text('{"name"')
    assert read_session(tmp_path).names == ("view_000",)


def test_a_session_is_not_started_twice(tmp_path: Path) -> None:
    create_session(tmp_path, HEADER)
    with pytest.raises(ConfigError, match="there is a session already; go on with --resume"):
        create_session(tmp_path, HEADER)


def test_a_session_without_views_is_refused_by_the_solver(tmp_path: Path) -> None:
    create_session(tmp_path, HEADER)
    assert solve(read_session(tmp_path)).verdict.words == "0 of 0 views are usable"


def test_what_is_wrong_with_a_session_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no session folder: it has no session\.json"):
        read_session(tmp_path)
    create_session(tmp_path, HEADER)
    with pytest.raises(ConfigError, match="mount is fixed in the session and flange on the command line"):
        read_session(tmp_path, "flange")
    (tmp_path / "views" / "a.json").write_text('{"name": "a"}')
    with pytest.raises(ConfigError, match=r"a\.json: T_base_flange: Field required"):
        read_session(tmp_path)
    (tmp_path / "session.json").write_text('{"version": 7}')
    with pytest.raises(ConfigError, match="version 7; this program reads 1"):
        load_header(tmp_path)


def test_views_are_read_from_a_folder_or_a_file(tmp_path: Path) -> None:
    views, _ = make_views(0, 3)
    write_session(tmp_path / "s", views)
    from_folder = read_views(tmp_path / "s")
    from_file = read_views(write(tmp_path / "corners.json", corners_file(views)))
    assert from_folder.names == from_file.names == views.names
    np.testing.assert_allclose(from_folder.T_base_flange, from_file.T_base_flange, atol=1e-12)


def test_a_session_that_cannot_be_written_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="file"):
        create_session(tmp_path / "file" / "s", HEADER)
    views, _ = make_views(0, 1)
    create_session(tmp_path / "s", HEADER)
    (tmp_path / "s" / "views" / "view_000.png").mkdir()
    with pytest.raises(StorageError, match=r"view_000\.png"):
        add_view(tmp_path / "s", record(views, 0), picture(), None)
    assert load_records(tmp_path / "s") == []
