"""Files from elsewhere: read up to a size, without trust."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from robotcell.errors import ConfigError
from robotcell.io.input_file import SETTINGS_MAX_BYTES, read_bytes, read_json, read_text, read_toml


def test_a_file_of_the_largest_size_is_read_and_one_byte_more_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * 100)
    assert read_bytes(path, 100) == b"x" * 100
    with pytest.raises(ConfigError, match=rf"{re.escape(str(path))}: larger than 9.9e-05 MB.*is it the right file\?"):
        read_bytes(path, 99)


def test_a_source_without_an_end_is_refused() -> None:
    with pytest.raises(ConfigError, match="/dev/zero: larger than 1 MB"):
        read_toml(Path("/dev/zero"))


def test_a_byte_order_mark_and_the_line_ends_of_other_systems_are_no_content(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_bytes(b'\xef\xbb\xbfname = "a"\r\ntext = """b\r\nc"""\r\n')
    assert read_toml(path) == {"name": "a", "text": "b\nc"}
    assert read_text(path, SETTINGS_MAX_BYTES).startswith("name")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\xff\xfe[\x00", "not a text file in UTF-8"),
        (b"x = [1, 0", "not a TOML file"),
        (b"x = " + 5000 * b"1", "not a TOML file"),
        (b"x = " + 100_000 * b"[", "nested too deeply"),
    ],
)
def test_what_is_no_toml_is_named(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "file.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"^{re.escape(str(path))}: .*{reason}"):
        read_toml(path)


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"[", "not a JSON file"), (5000 * b"1", "not a JSON file"), (100_000 * b"[", "nested too deeply")],
)
def test_what_is_no_json_is_named(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"^{re.escape(str(path))}: .*{reason}"):
        read_json(path, SETTINGS_MAX_BYTES)


def test_a_path_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere: no such file; make one"):
        read_bytes(tmp_path / "nowhere", 1, "make one")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        read_bytes(tmp_path, 1)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_bytes(Path("a\0b"), 1)
