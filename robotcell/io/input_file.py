"""Files from elsewhere. None is trusted: each is read up to a size that such a file never needs, and no further.

What is wrong with one is a `ConfigError` that names the file. Nothing in a file is ever run.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

from robotcell.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if TYPE_CHECKING:
    from pathlib import Path

# Settings and scenes that people write are a few kilobytes long.
SETTINGS_MAX_BYTES = 1_000_000
# Measurements: an hour of poses at 500 Hz is 180 MB of text.
MEASUREMENTS_MAX_BYTES = 256_000_000


def read_bytes(path: Path, max_bytes: int, missing: str = "") -> bytes:
    """The content of a file.

    Args:
        path: of the file.
        max_bytes: size of the largest file that is accepted.
        missing: what to do where there is no such file, for the error.

    Raises:
        ConfigError: it is not there, cannot be read, or is larger.
    """
    try:
        with path.open("rb") as file:
            # One byte more than allowed: a pipe or a device does not say its size beforehand.
            content = file.read(max_bytes + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file{'; ' if missing else ''}{missing}") from None
    except (OSError, ValueError) as error:
        # ValueError: a null character in the path.
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(content) > max_bytes:
        raise ConfigError(
            f"{path}: larger than {max_bytes / 1e6:g} MB, the most that a file of this kind may have; is it the right "
            "file?"
        )
    return content


def read_text(path: Path, max_bytes: int, missing: str = "") -> str:
    """The text of a UTF-8 file, without a byte order mark; lines end with a line feed, whatever the file has.

    Raises:
        ConfigError: as `read_bytes`, and where it is no text.
    """
    content = read_bytes(path, max_bytes, missing)
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file in UTF-8: {error}") from error


def read_toml(path: Path, missing: str = "") -> dict[str, Any]:
    """The values of a TOML file of at most `SETTINGS_MAX_BYTES`.

    Raises:
        ConfigError: as `read_text`, and where it is no TOML.
    """
    return parse_toml(read_text(path, SETTINGS_MAX_BYTES, missing), path)


def parse_toml(text: str, place: Path | str) -> dict[str, Any]:
    """The values of a text in TOML.

    Raises:
        ConfigError: it is no TOML; the message names `place`.
    """
    try:
        values: dict[str, Any] = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{place}: not a TOML file: it is nested too deeply") from None
    except ValueError as error:  # of the syntax, or of an integer of thousands of digits
        raise ConfigError(f"{place}: not a TOML file: {error}") from None
    return values


def read_json(path: Path, max_bytes: int, missing: str = "") -> Any:
    """The content of a JSON file.

    Raises:
        ConfigError: as `read_text`, and where it is no JSON.
    """
    text = read_text(path, max_bytes, missing)
    try:
        return json.loads(text)
    except RecursionError:
        raise ConfigError(f"{path}: not a JSON file: it is nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not a JSON file: {error}") from None
