"""Twins with one block, put where a test wants it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.config import load_config
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import Array, make_transform
from sim_twin.devices import backend
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import block

if TYPE_CHECKING:
    from robotcell.cell import Cell
    from sim_twin.world.world import World

PERIOD_S = 0.008
# Near the middle of the workspace, elbow up.
_Q_NEAR = (-0.27, -1.55, 1.70, -1.70, -1.57, 1.3)


def with_block(name: str, x: float, y: float, turn: Array | None = None) -> tuple[Cell, World]:
    """A cell, not yet connected, on whose table a single block stands; and its world."""
    shape = block(name)
    R = np.eye(3) if turn is None else turn
    z = -float((shape.mesh.vertices @ R.T)[:, 2].min())
    item = SceneObject("block", shape, (200, 30, 30), make_transform(R, (x, y, z)))
    return backend.open_twin(load_config(), Scene("one block", (item,), drop=False))


def open_twin(**options: object) -> tuple[Cell, World]:
    """A twin, not yet connected, and its world."""
    return backend.open_twin(load_config(None, {f"backend.options.{key}": value for key, value in options.items()}))


def tool_down(x: float, y: float, z: float, yaw: float = 0.0) -> Array:
    """T_base_tcp of an upright tool; at yaw 0 the fingers close along base x."""
    c, s = np.cos(yaw), np.sin(yaw)
    return make_transform([[c, s, 0], [s, -c, 0], [0, 0, -1]], (x, y, z))


def joints_at(T_base_tcp: Array) -> Array:
    """Joint angles, elbow up, that put the tcp there."""
    q = ur5e.inverse(T_base_tcp @ np.linalg.inv(rg2.T_FLANGE_TCP), _Q_NEAR)
    assert q is not None
    return q


def go(cell: Cell, T_base_tcp: Array, speed: float = 0.25, guard_n: float = np.inf) -> None:
    """Move straight there under supervision; stop at a contact force."""
    cell.arm.start_linear(T_base_tcp, speed, 1.2)
    finish(cell, guard_n)


def finish(cell: Cell, guard_n: float = np.inf) -> None:
    """Supervise the motion under way to its end."""
    while cell.arm.moving:
        cell.arm.kick()
        cell.clock.sleep(PERIOD_S)
        if np.linalg.norm(cell.arm.state().wrench[:3]) > guard_n:
            cell.arm.stop()


def close_on(cell: Cell, width_m: float, force_n: float) -> None:
    """Move the fingers and wait until they rest."""
    cell.gripper.start_width(width_m, force_n)
    cell.clock.sleep(PERIOD_S)
    while cell.gripper.state().busy:
        cell.clock.sleep(PERIOD_S)
