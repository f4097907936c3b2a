import pytest

from robotcell.errors import ConfigError
from sim_twin.wire.twin_config import load_as_twin

HARDWARE = """
[table]
height_m = 0.02
[backend]
name = "hardware"
[backend.options.arm]
host = "192.168.0.2"
[backend.options.gripper]
host = "192.168.0.3"
"""


def test_the_twin_of_a_real_cell_keeps_its_arrangement(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(HARDWARE, encoding="utf-8")
    config = load_as_twin(path, {"backend.options.objects": 3})
    assert config.backend.name == "twin"
    assert config.backend.options == {"objects": 3}
    assert config.table.height_m == 0.02


def test_the_options_of_a_twin_stay_below_those_that_are_given(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text('[backend]\nname = "twin"\n[backend.options]\nobjects = 4\nseed = 1\n', encoding="utf-8")
    config = load_as_twin(path, {"backend.options.seed": 2, "table.height_m": 0.01})
    assert config.backend.options == {"objects": 4, "seed": 2}
    assert config.table.height_m == 0.01


def test_a_wrong_option_is_named_as_it_was_given():
    with pytest.raises(ConfigError, match="--objects"):
        load_as_twin(None, {"backend.options.objects": 99}, {"backend.options.objects": "--objects"})
