"""The configuration of the twin of a cell, whatever the cell's own backend is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotcell.config import load_config

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from robotcell.config import CellConfig

_OPTIONS = "backend.options."


def load_as_twin(
    path: Path | None, overrides: Mapping[str, Any] | None = None, said_as: Mapping[str, str] | None = None
) -> CellConfig:
    """The cell of a file with the twin for its backend.

    Args:
        path: TOML file of the cell; its arrangement is kept, and the backend's options where that is the twin.
        overrides: as of `load_config`; options of the backend are those of the twin.
        said_as: as of `load_config`.

    Raises:
        ConfigError: as `load_config`.
    """
    given = dict(overrides or {})
    options = {key: given.pop(key) for key in list(given) if key.startswith(_OPTIONS)}
    backend = load_config(path, given, said_as).backend
    own = backend.options if backend.name == "twin" else {}
    return load_config(path, {**given, "backend.name": "twin", "backend.options": own, **options}, said_as)
