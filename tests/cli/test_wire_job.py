"""A whole job through the real client libraries, against a served twin in real time."""

from __future__ import annotations

import json
import subprocess
import sys
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from robotcell.config import load_config
from sim_twin.wire.cell import ServedCell
from tests.addresses import loopback

if TYPE_CHECKING:
    from collections.abc import Iterator

HOST, MODBUS_PORT, CAMERA_PORT = loopback(49), 15049, 30449
LIMIT_S = 240.0


@pytest.fixture(scope="module")
def served() -> Iterator[ServedCell]:
    resource_tracker.ensure_running()
    # The scene that `robotcell twin serve` has unless told otherwise.
    with ServedCell(load_config(), HOST, MODBUS_PORT, CAMERA_PORT) as cell:
        yield cell


@pytest.mark.wire
@pytest.mark.usefixtures("served")
def test_a_goal_is_picked_over_the_wire(tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "examples" / "wire.toml"
    addresses = {"127.0.0.2": HOST, "1502": str(MODBUS_PORT), "30415": str(CAMERA_PORT)}
    text = example.read_text()
    for old, new in addresses.items():
        text = text.replace(old, new)
    (tmp_path / "wire.toml").write_text(text)
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from cli.main import main; main()",
            "pick",
            "--goal",
            "red",
            "--cell",
            "wire.toml",
            "--json",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    report = json.loads(done.stdout)
    assert report["completed"], report["reason"]
    assert report["picked_objects"] == ["red"]
    assert done.returncode == 0
