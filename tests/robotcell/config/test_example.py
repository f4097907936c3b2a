"""The example cell shows every setting, with its default where there is one."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from robotcell.config import CellConfig, load_config
from sim_twin.options import TwinOptions

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

EXAMPLE = Path(__file__).parents[3] / "examples" / "cell.toml"
# What makes the example the cell of `make demo`.
OF_ITS_OWN = {"camera.calibration", "backend.options.camera_offset"}
# A line of TOML behind a comment sign.
HIDDEN = re.compile(r"^# (\[\[?[\w.]+\]\]?$|\w+ = )", re.MULTILINE)


def settings(model: type[BaseModel], prefix: str = "") -> dict[str, Any]:
    """The default of every setting by its dotted key; those of a list of tables by the table's key."""
    found: dict[str, Any] = {}
    for key, field in model.model_fields.items():
        if isinstance(field.default, BaseModel):
            found |= settings(type(field.default), f"{prefix}{key}.")
        else:
            found[prefix + key] = field.default
    return found


def shown(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of a file by dotted key."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= shown(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found


def defaults() -> dict[str, Any]:
    cell = settings(CellConfig)
    del cell["backend.options"]
    return cell | settings(TwinOptions, "backend.options.")


def as_toml(value: Any) -> Any:
    if isinstance(value, tuple):
        return [as_toml(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


EVERY_SETTING = defaults()


@pytest.mark.parametrize("key", EVERY_SETTING)
def test_the_example_shows_the_setting_with_its_default(key: str) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    visible = shown(tomllib.loads(text))
    everything = shown(tomllib.loads(HIDDEN.sub(r"\1", text)))
    default = EVERY_SETTING[key]
    assert key in everything
    if key in OF_ITS_OWN:
        assert visible[key] != as_toml(default)
    elif default is None or default == ():
        assert key not in visible
    else:
        assert visible[key] == as_toml(default)


def test_the_example_shows_nothing_else() -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    assert set(shown(tomllib.loads(HIDDEN.sub(r"\1", text)))) == set(EVERY_SETTING)


def test_with_every_setting_shown_the_example_is_still_a_cell(tmp_path: Path) -> None:
    text = HIDDEN.sub(r"\1", EXAMPLE.read_text(encoding="utf-8"))
    # The two ways to say where the camera stands exclude each other.
    path = tmp_path / "cell.toml"
    path.write_text(re.sub(r"^calibration = .*$", "", text, flags=re.MULTILINE), encoding="utf-8")
    assert load_config(path).keep_out[0].name == "shelf"
