"""The backend of real devices: opened by cell.toml, its vendors' libraries left alone until a device connects."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from robotcell.cell import open_cell
from robotcell.config import find_backend, load_config
from robotcell.drivers.clock import WallClock
from robotcell.errors import ConfigError, ConnectionLost

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.mark.parametrize("name", ["wire.toml", "hardware.toml"])
def test_the_examples_open(name: str) -> None:
    cell = open_cell(load_config(EXAMPLES / name))
    assert isinstance(cell.clock, WallClock)
    for call in (cell.arm.state, cell.gripper.state, cell.camera.read):
        with pytest.raises(ConnectionLost):
            call()
    cell.close()


def test_a_cell_is_named_by_the_address_of_its_arm_whichever_name_the_file_uses() -> None:
    def name(host: str) -> str | None:
        config = load_config(EXAMPLES / "wire.toml", {"backend.options.arm.host": host})
        return find_backend("hardware").cell_name(config)

    assert name("localhost") == name("127.0.0.1") == name("127.1") == "arm-127.0.0.1"
    assert name("127.0.0.2") != name("127.0.0.1")
    assert name("Nowhere.invalid") == "arm-nowhere.invalid"
    assert find_backend("twin").cell_name(load_config()) is None


def test_options_of_the_twin_are_refused() -> None:
    with pytest.raises(ConfigError) as refusal:
        load_config(EXAMPLES / "wire.toml", {"backend.options.seed": 3, "backend.options.arm.speed": 1})
    assert "backend.options.seed = 3: unknown key" in str(refusal.value)
    assert "backend.options.arm.speed = 1: unknown key" in str(refusal.value)


def test_a_cell_without_addresses_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"backend\.options\.arm: missing"):
        load_config(None, {"backend.name": "hardware"})
    with pytest.raises(ConfigError, match="payload_kg"):
        load_config(EXAMPLES / "wire.toml", {"backend.options.arm.payload_kg": float("nan")})


def test_neither_the_command_nor_a_cell_that_is_not_connected_loads_a_vendors_library() -> None:
    program = (
        "import sys, cli.main, cli.doctor, robotcell.drivers.backend\n"
        "from pathlib import Path\n"
        "from robotcell.cell import open_cell\n"
        "from robotcell.config import load_config\n"
        f"open_cell(load_config(Path({str(EXAMPLES / 'hardware.toml')!r})))\n"
        "vendors = {'rtde_control', 'rtde_receive', 'pymodbus', 'pyrealsense2', 'pybullet'}\n"
        "sys.exit(', '.join(vendors & set(sys.modules)) or 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
