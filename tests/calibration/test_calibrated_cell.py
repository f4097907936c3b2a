"""What a calibration measured is what a job uses: a twin camera with wrong intrinsics and a wrong depth scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.main import app
from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.config.calibration_file import load_calibration

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.perception.view import View

# Two cubes of 50 mm and a block of 100 mm, far from the middle of the workspace: (x, y) there, and their heights [m].
BLOCKS = {"red": (-0.12, 0.12, 0.05), "blue": (0.14, -0.13, 0.05), "green": (0.1, 0.1, 0.1)}
CELL = """
[camera]
{camera}
[limits]
max_table_offset_m = 0.05
max_tilt_rad = 0.1
[journal]
runs = "{folder}/runs"
[backend.options]
scene = "{folder}/blocks.toml"
camera_offset = [0.009, -0.007, 0.006, 0.006, -0.008, 0.010]
intrinsics_error = {{ focal = 0.01, cx_px = 3.0, cy_px = -2.0 }}
depth_error = {{ scale = 1.012, offset_m = 0.003 }}
"""


def run(*arguments: str | Path) -> None:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cell files before and after a calibration that refined the intrinsics."""
    folder = tmp_path_factory.mktemp("calibrated")
    objects = "".join(
        f'[[object]]\nname = "{color}"\nshape = "{"cube" if height < 0.1 else "tall_block"}"\ncolor = "{color}"\n'
        f"position = [{x}, {y}, {height / 2}]\n"
        for color, (x, y, height) in BLOCKS.items()
    )
    (folder / "blocks.toml").write_text(f'name = "known blocks"\ndrop = false\n{objects}')
    for name, camera in (("before", ""), ("after", 'calibration = "camera.json"')):
        (folder / f"{name}.toml").write_text(CELL.format(camera=camera, folder=folder))
    # With the intrinsics that the camera reports, the calibration is refused; its views are kept.
    CliRunner().invoke(app, ["calibrate", "--cell", str(folder / "before.toml"), "--views", "14", "--seed", "3"])
    (session,) = (folder / "runs" / "calibration").iterdir()
    run("calibrate", "solve", session, "--refine-intrinsics", "--out", folder / "camera.json")
    return folder


def look(path: Path) -> View:
    with open_cell(load_config(path)) as cell:
        return cell.look()


def height_errors(view: View) -> dict[str, float]:
    """The median height of the middle of each block, less what it is [m]."""
    workspace, heights = view.heightmap.workspace, view.heightmap.height_m
    errors = {}
    for color, (x, y, height) in BLOCKS.items():
        row, col = workspace.cell(x + sum(workspace.x) / 2, y + sum(workspace.y) / 2)
        errors[color] = float(np.nanmedian(heights[row - 8 : row + 9, col - 8 : col + 9])) - height
    return errors


def test_the_calibration_finds_what_is_wrong(folder: Path) -> None:
    found = load_calibration(folder / "camera.json")
    assert found.intrinsics_refined
    assert found.depth is not None
    assert found.depth.scale == pytest.approx(1 / 1.012, abs=0.003)


def test_known_blocks_have_their_heights_and_places_with_the_calibration(folder: Path) -> None:
    view = look(folder / "after.toml")
    assert max(map(abs, height_errors(view).values())) < 0.001
    for instance in view.segmentation.instances:
        x, y, _ = BLOCKS[instance.color_name]
        middle = (x + sum(view.heightmap.workspace.x) / 2, y + sum(view.heightmap.workspace.y) / 2)
        assert np.hypot(*np.subtract(instance.centroid, middle)) < 0.003
    assert view.heightmap.table is not None
    assert abs(view.heightmap.table.offset_m) < 0.001


def test_without_the_calibration_they_have_not(folder: Path) -> None:
    assert min(map(abs, height_errors(look(folder / "before.toml")).values())) > 0.010
