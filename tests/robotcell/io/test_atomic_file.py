"""Files that are there as a whole or not at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from robotcell.errors import StorageError
from robotcell.io.atomic_file import replaced, write_whole

if TYPE_CHECKING:
    from pathlib import Path


def test_what_is_written_takes_the_place_of_what_was(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for text in ("one", "zwei Grüße"):
        write_whole(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_what_was(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write() -> None:
        with replaced(path) as part:
            part.write_bytes(b"ne")
            assert path.read_bytes() == b"old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_missing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"a\.txt cannot be written: No such file"):
        write_whole(tmp_path / "missing" / "a.txt", "x")
