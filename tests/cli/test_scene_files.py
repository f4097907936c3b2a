from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from cli.main import app
from robotcell.config import load_config
from robotcell.geometry.transforms import transform_points
from robotcell.perception.colors import PALETTE
from sim_twin.devices.backend import open_twin

if TYPE_CHECKING:
    from pathlib import Path

# A plank of 100 x 50 x 25 mm, each side a quad.
PLANK = """\
v -0.05 -0.025 -0.0125
v 0.05 -0.025 -0.0125
v 0.05 0.025 -0.0125
v -0.05 0.025 -0.0125
v -0.05 -0.025 0.0125
v 0.05 -0.025 0.0125
v 0.05 0.025 0.0125
v -0.05 0.025 0.0125
f 4 3 2 1
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""
# A channel of 60 x 60 x 60 mm with walls of 20 mm, open upwards; its front and back are one polygon each.
CHANNEL_OUTLINE = [(-3, -3), (3, -3), (3, 3), (1, 3), (1, -1), (-1, -1), (-1, 3), (-3, 3)]
CHANNEL = "\n".join(
    [
        *(f"v {x / 100} {y / 100} {z / 100}" for y in (-3, 3) for x, z in CHANNEL_OUTLINE),
        "f 1 2 3 4 5 6 7 8",
        "f 16 15 14 13 12 11 10 9",
        *(f"f {i + 1} {i + 9} {(i + 1) % 8 + 9} {(i + 1) % 8 + 1}" for i in range(8)),
    ]
)
# The frame of a plank has its thinnest side along x and its longest along z: a quarter turn about y lays it flat.
QUARTER = np.pi / 2
NAMED = f"# two objects\nred plank.obj -0.5 0.1 0.0125 0 {QUARTER} 0\nblock channel.obj -0.55 -0.1 0.03 {{turn}}\n"
VPG = f"objects/plank.obj 1.0 0.3412 0.349 -0.5 0.1 0.0125 0 {QUARTER} 0\nchannel.obj 0 0 1 -0.55 -0.1 0.03 {{turn}}\n"


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "plank.obj").write_text(PLANK)
    (folder / "channel.obj").write_text(CHANNEL)
    # Says which of its axes the channel's frame has, whatever its moments are.
    (folder / "frames.toml").write_text('["channel.obj"]\nx = [1, 0, 0]\ny = [0, 1, 0]\n')
    return folder


def written(tmp_path: Path, rows: str) -> Path:
    path = tmp_path / "scene.txt"
    path.write_text(rows.format(turn=f"0 0 {QUARTER}"))
    return path


def pick(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["pick", "--goal", "red", *map(str, arguments)])


@pytest.mark.parametrize("rows", [NAMED, VPG])
def test_the_objects_of_a_scene_file_settle_where_it_puts_them(tmp_path: Path, meshes: Path, rows: str) -> None:
    options = {"backend.options.scene": str(written(tmp_path, rows)), "backend.options.meshes": str(meshes)}
    cell, world = open_twin(load_config(overrides=options))
    with cell:
        objects = world.objects()
    plank, channel = (transform_points(T, item.shape.mesh.vertices) for item, T in objects)
    np.testing.assert_allclose(plank.min(axis=0), (-0.55, 0.075, 0), atol=0.002)
    np.testing.assert_allclose(plank.max(axis=0), (-0.45, 0.125, 0.025), atol=0.002)
    np.testing.assert_allclose(channel.min(axis=0), (-0.58, -0.13, 0), atol=0.002)
    np.testing.assert_allclose(channel.max(axis=0), (-0.52, -0.07, 0.06), atol=0.002)
    # The channel stands open upwards; a quarter turn has put its walls along x.
    inner = channel[np.abs(channel[:, 2] - 0.02).argsort()[:4]]
    np.testing.assert_allclose(np.unique(inner[:, 1].round(2)), (-0.11, -0.09), atol=1e-9)
    assert objects[0][0].color == PALETTE["red"]
    assert objects[1][0].color != PALETTE["red"]


@pytest.mark.parametrize("rows", [NAMED, VPG])
def test_the_goal_of_a_scene_file_is_found(tmp_path: Path, meshes: Path, rows: str) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(f'[journal]\nruns = "{tmp_path / "runs"}"\n')
    result = pick("--scene", written(tmp_path, rows), "--meshes", meshes, "--cell", cell, "--dry-run", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["primitive"] == "grasp"


@pytest.mark.parametrize(
    ("rows", "mesh", "message"),
    [
        ("red plank.obj -0.5 0 high 0 0 0", PLANK, "scene.txt, line 1: z is 'high', which is no number"),
        ("red board.obj -0.5 0 0 0 0 0", PLANK, "scene.txt, line 1: there is no board.obj"),
        ("red plank.obj -0.5 0 0 0 0 0", PLANK.replace("f 1 2 6 5\n", ""), "plank.obj: the surface is flat or not"),
        (
            "red plank.obj -0.5 0 0 0 0 0",
            PLANK + "f 1 2 99\n",
            "plank.obj: a face names a vertex that is not in the file",
        ),
        ("red plank.obj -0.5 0 0 0 0 0", PLANK.replace("0.05", "50"), "plank.obj: extent 100 m; it is read in metres"),
    ],
)
def test_a_bad_row_or_mesh_ends_the_command_with_the_reason(
    tmp_path: Path, meshes: Path, rows: str, mesh: str, message: str
) -> None:
    (meshes / "plank.obj").write_text(mesh)
    result = pick("--scene", written(tmp_path, rows), "--meshes", meshes, "--dry-run")
    assert result.exit_code == 2, result.output
    assert message in " ".join(result.stderr.split())


def test_a_folder_of_meshes_without_a_scene_file_is_refused(meshes: Path) -> None:
    result = pick("--meshes", meshes, "--dry-run")
    assert result.exit_code == 2, result.output
    assert "--meshes" in result.stderr
