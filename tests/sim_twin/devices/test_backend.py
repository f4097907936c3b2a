import subprocess
import sys

import pytest

from robotcell.config import load_config
from robotcell.errors import ConfigError


@pytest.mark.parametrize(
    ("key", "value"),
    [("objects", 0), ("objects", 61), ("seed", -1), ("sceen", "random"), ("noise", {"fog": True})],
)
def test_wrong_options_are_refused_with_their_key(key, value):
    with pytest.raises(ConfigError, match=f"backend.options.{key}"):
        load_config(None, {f"backend.options.{key}": value})


def test_nothing_heavy_is_imported_before_the_cell_is_connected():
    code = (
        "import sys; from robotcell.config import load_config; from robotcell.cell import open_cell; "
        "open_cell(load_config()); "
        "print([m for m in ('pybullet', 'open3d') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
