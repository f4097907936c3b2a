"""The served cell of the drivers' tests: where it is, and what lies in it."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from robotcell.config import load_config
from sim_twin.wire.cell import ServedCell
from tests.addresses import loopback

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HOST, MODBUS_PORT, CAMERA_PORT = loopback(45), 15045, 30445
# One cube in the middle of the workspace, for the gripper to feel.
_SCENE = """
name = "one cube"
[[object]]
name = "cube"
shape = "cube"
color = "red"
position = [0.0, 0.0, 0.025]
"""


@contextmanager
def serve(
    folder: Path, host: str = HOST, modbus_port: int = MODBUS_PORT, camera_port: int = CAMERA_PORT
) -> Iterator[ServedCell]:
    """Serve the cell; its scene is written to a folder."""
    scene = folder / "cube.toml"
    scene.write_text(_SCENE, encoding="utf-8")
    config = load_config(None, {"backend.name": "twin", "backend.options.scene": str(scene)})
    with ServedCell(config, host, modbus_port, camera_port) as served:
        yield served
