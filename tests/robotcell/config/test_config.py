from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotcell.cell import open_cell
from robotcell.config import CellConfig, Workspace, load_config
from robotcell.errors import ConfigError

EXAMPLE = Path(__file__).parents[3] / "examples" / "cell.toml"


def test_without_a_file_the_twin_stands_ready() -> None:
    config = load_config()
    assert config.backend.name == "twin"
    assert config.policy.name == "learned"


def test_a_relative_calibration_file_lies_beside_the_cells_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_config(EXAMPLE).camera.calibration == EXAMPLE.with_name("twin-calibration.json")


def test_every_bad_value_is_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(
        """
        [workspace]
        x = [-0.2, -0.7]
        [table]
        height_m = "high"
        [motion]
        joint_speed_rad_s = 9
        sped = 1
        [gripper]
        force_n = 400
        [camera]
        T_base_camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
        [[keep_out]]
        name = "shelf"
        x = [0, 1]
        y = [0, 1]
        [backend.options]
        objects = -3
        colour = "mauve"
        """
    )
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    message = str(caught.value)
    for expected in (
        "9 wrong value(s)",
        "workspace.x = [-0.2, -0.7]: the first number must be below the second",
        "table.height_m = 'high': Input should be a valid number",
        "motion.joint_speed_rad_s = 9: Input should be less than or equal to 3.14",
        "motion.sped = 1: unknown key",
        "gripper.force_n = 400: Input should be less than or equal to 40",
        "T_base_camera is mirrored",
        "keep_out.0.z: missing",
        "backend.options.objects = -3: Input should be greater than or equal to 1",
        "backend.options.colour = 'mauve': unknown key",
    ):
        assert expected in message


@pytest.mark.parametrize(
    ("text", "reason"),
    [("[workspace", "not a TOML file"), ('[backend]\nname = "spot"', "no backend is called 'spot'; installed: .*twin")],
)
def test_a_bad_file_says_why(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_config(path)


def test_a_missing_file_points_to_the_example(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no such file; start from examples/cell\.toml"):
        load_config(tmp_path / "cell.toml")


def test_overrides_stand_above_the_file(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text("[backend.options]\nseed = 1\nobjects = 4\n")
    config = load_config(path, {"backend.options.seed": 7, "policy.name": "other"})
    assert config.backend.options == {"seed": 7, "objects": 4}
    assert config.policy.name == "other"


def test_an_unknown_backend_cannot_be_opened() -> None:
    with pytest.raises(ConfigError, match="no backend is called 'spot'"):
        open_cell(CellConfig.model_validate({"backend": {"name": "spot"}}))


@given(st.integers(0, 223), st.integers(0, 223))
def test_cells_and_positions_are_inverse(row: int, col: int) -> None:
    workspace = Workspace()
    assert workspace.shape == (224, 224)
    assert workspace.cell(*workspace.position(row, col)) == (row, col)
