"""Whatever a file holds, its reader returns, or refuses it in words: a `ConfigError`, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calibration.solve.readers.pose_csv import read_series
from calibration.solve.readers.view_file import read_file
from policy.network.weights import load_weights
from policy.training.config import load_train_config
from robotcell.config import load_config
from robotcell.config.calibration_file import load_calibration
from robotcell.errors import ConfigError
from sim_twin.scenes.files import read_scene
from sim_twin.scenes.mesh_files import MESH_SUFFIXES, load_meshes
from tests.calibration.solve.readers.test_view_file import corners_file
from tests.calibration.synthetic import make_views

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
SCENE = b"""name = "two"
[[object]]
name = "goal"
shape = "cube"
color = "red"
position = [0.0, 0.0, 0.025]
[[object]]
name = "other"
shape = "cube"
color = "blue"
position = [0.1, 0.1, 0.025]
rotation = [0.0, 0.0, 0.5]
"""
ROWS = b"0.obj 0.9 0.1 0.1 -0.5 0.0 0.025 0.0 0.0 0.0\n0.obj 0.1 0.9 0.1 -0.4 0.1 0.025 0.0 0.0 1.5\n"


def _series() -> bytes:
    rows = (f"{0.1 * i:.1f},0.1,{0.01 * i:.2f},0.3,0,0,0,1" for i in range(14))
    return "\n".join(["t,x,y,z,qx,qy,qz,qw", *rows]).encode()


def _corners() -> bytes:
    return json.dumps(corners_file(make_views(0, 3)[0])).encode()


def _mesh(suffix: str) -> bytes:
    found: Any = trimesh.creation.box((0.05, 0.04, 0.03)).export(file_type=suffix[1:])
    return found.encode() if isinstance(found, str) else bytes(found)


READERS: dict[str, tuple[str, Callable[[], bytes], Callable[[Path], object]]] = {
    "cell": (".toml", (EXAMPLES / "cell.toml").read_bytes, load_config),
    "training": (".toml", (EXAMPLES / "train.toml").read_bytes, load_train_config),
    "calibration": (".json", (EXAMPLES / "twin-calibration.json").read_bytes, load_calibration),
    "corners": (".json", _corners, read_file),
    "series": (".csv", _series, read_series),
    "weights": (".safetensors", (ROOT / "policy" / "data" / "learned.safetensors").read_bytes, load_weights),
    "scene": (".toml", lambda: SCENE, lambda path: read_scene(path, None)),
    "published scene": (".txt", lambda: ROWS, lambda path: read_scene(path, path.parent)),
    **{f"mesh{suffix}": (suffix, lambda suffix=suffix: _mesh(suffix), load_meshes) for suffix in MESH_SUFFIXES},
}
# What parsers stumble over: deep nests, huge and special numbers, characters of their own syntax.
TOKENS = st.sampled_from(
    [b"[" * 3000, b"{" * 300, b"9" * 5000, b"1e999", b"nan", b"-1", b"-0.0", b"4294967295", b"\x00", b"\xff\xfe", b'"',
     b"\\", b"\n", b",", b"=", b"f 1 2 99999\n", b"null", b"true", b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"\x80" * 8]
)  # fmt: skip
EDITS = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 40), TOKENS | st.binary(max_size=8)), max_size=4)


def edited(content: bytes, edits: list[tuple[float, int, bytes]], cut: float) -> bytes:
    """A content with pieces replaced, cut off at a share of its length."""
    for place, length, put in edits:
        at = int(place * len(content))
        content = content[:at] + put + content[at + length :]
    return content[: int(cut * len(content))]


@pytest.mark.parametrize("kind", READERS)
def test_a_reader_returns_or_says_what_is_wrong(kind: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    suffix, valid, read = READERS[kind]
    content = valid()
    path = tmp_path_factory.mktemp("untrusted") / f"file{suffix}"
    (path.parent / "twin-calibration.json").write_bytes((EXAMPLES / "twin-calibration.json").read_bytes())
    (path.parent / "0.obj").write_bytes(_mesh(".obj"))
    path.write_bytes(content)
    read(path)

    @settings(max_examples=30, suppress_health_check=list(HealthCheck))
    @given(EDITS, st.sampled_from([1.0, 1.0, 0.97, 0.5, 0.0]))
    def check(edits: list[tuple[float, int, bytes]], cut: float) -> None:
        path.write_bytes(edited(content, edits, cut))
        try:
            read(path)
        except ConfigError as error:
            assert str(path) in str(error)

    check()
