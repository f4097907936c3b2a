"""Reading `cell.toml`: one file that describes a cell, checked as a whole. With no file the twin with its defaults."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from robotcell.config.backends import find_backend
from robotcell.config.schema import BackendChoice, CellConfig
from robotcell.errors import ConfigError
from robotcell.io.input_file import parse_toml, read_toml

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_DOCS = "docs/reference/configuration.md"


def load_config(
    path: Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    said_as: Mapping[str, str] | None = None,
) -> CellConfig:
    """Read and check a cell file.

    Args:
        path: a TOML file; None for the twin with its defaults.
        overrides: values by dotted key (`backend.options.seed`) that stand above those of the file.
        said_as: what the user wrote before an override's value (`--seed `), by dotted key, for the words of errors.

    Raises:
        ConfigError: naming every bad key at once, each with its value and what is allowed.
    """
    values = read_toml(path, "start from examples/cell.toml") if path else {}
    if path:
        _beside(values, path)
    for key, value in (overrides or {}).items():
        _set(values, key, value)
    problems: list[str] = []
    config = None
    try:
        config = CellConfig.model_validate(values)
    except ValidationError as error:
        problems += wrong_values(error, _DOCS)
    backend_table = values.get("backend", {})
    if isinstance(backend_table, dict):
        try:
            backend = find_backend(str(backend_table.get("name", BackendChoice().name)))
            backend.Options.model_validate(backend_table.get("options", {}))
        except ConfigError as error:
            problems.append(f"backend.name: {error}")
        except ValidationError as error:
            problems += wrong_values(error, _DOCS, ("backend", "options"))
    if config is None or problems:
        place = str(path) if path else "the cell's settings"
        for key, words in (said_as or {}).items():
            start = f"{key} = "
            problems = [words + line.removeprefix(start) if line.startswith(start) else line for line in problems]
        raise ConfigError("\n  ".join([f"{place}: {len(problems)} wrong value(s)", *problems]))
    return config


def parse_setting(text: str) -> tuple[str, Any]:
    """Key and value of `table.key=value`; the value as TOML has it, or else as a string.

    Raises:
        ConfigError: there is no key or no value.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not all(part.isidentifier() for part in key.split(".")):
        raise ConfigError(f"--set {text}: say KEY=VALUE, such as limits.force_n=80; see {_DOCS}")
    try:
        return key, parse_toml(f"value = {value}", "--set")["value"]
    except ConfigError:
        return key, value.strip()


def wrong_values(error: ValidationError, docs: str, prefix: tuple[str, ...] = ()) -> list[str]:
    """A line for each wrong key of a file: the key, its value and what is wrong with it.

    Args:
        error: of its validation.
        docs: the page that lists the keys.
        prefix: of the keys, where a part of the file was validated.
    """
    lines = []
    for detail in error.errors():
        key = ".".join(str(part) for part in (*prefix, *detail["loc"]))
        if detail["type"] == "missing":
            lines.append(f"{key}: missing")
        elif detail["type"] == "extra_forbidden":
            lines.append(f"{key} = {detail['input']!r}: unknown key; see {docs} for those that exist")
        else:
            lines.append(f"{key} = {detail['input']!r}: {detail['msg'].removeprefix('Value error, ')}")
    return lines


def _beside(values: dict[str, Any], path: Path) -> None:
    """A relative path of the calibration file starts at the folder of the cell's file."""
    camera = values.get("camera")
    if isinstance(camera, dict) and isinstance(camera.get("calibration"), str):
        camera["calibration"] = str(path.parent / camera["calibration"])


def _set(values: dict[str, Any], dotted_key: str, value: object) -> None:
    *tables, key = dotted_key.split(".")
    for table in tables:
        inner = values.setdefault(table, {})
        if not isinstance(inner, dict):
            return  # the file holds something else there, which the validation reports
        values = inner
    values[key] = value
