"""Lets the objects of a scene come to rest, and drops again those that leave the workspace."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from robotcell.errors import ConfigError
from sim_twin.world.bodies import is_at_rest, load_object, object_pose, put_body, put_to_sleep, wake

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from sim_twin.scenes.scene import Scene
    from sim_twin.world.bodies import Friction
    from sim_twin.world.simulation import Simulation

_DROP_STEPS = 72
SETTLE_SLICE = 24
_SETTLE_SLICES = 100
QUIET_SLICES = 3
_DROP_TRIES = 20
# The lowest point of a falling object starts this far above what lies below it.
_DROP_HEIGHT_M = 0.05


def load_scene(simulation: Simulation, scene: Scene, config: CellConfig, seed: int, friction: Friction) -> None:
    """Load the objects of a scene and wait until they rest in the workspace, asleep.

    Args:
        simulation: with the table, without the arm: an object never falls onto it.
        scene: what to load.
        config: of the cell.
        seed: of where objects are dropped again.
        friction: of the objects.

    Raises:
        ConfigError: the objects do not come to rest, or not in the workspace.
    """
    for item in scene.objects:
        body = load_object(simulation, item.shape, item.T_base_object, friction)
        simulation.bodies.append(body)
        if scene.drop:
            _let_fall(simulation, body, config.table.height_m)
            simulation.run(_DROP_STEPS)
    _settle(simulation, scene, config)
    if scene.drop:
        _drop_again(simulation, scene, config, np.random.default_rng([seed, 0xD50]))
    else:
        _check_on_table(simulation, scene, config)
    for body in simulation.bodies:
        if is_at_rest(simulation, body):
            put_to_sleep(simulation, body)


def is_in_workspace(simulation: Simulation, body: int, config: CellConfig) -> bool:
    """Whether the centre of an object is above the workspace."""
    x, y, z = object_pose(simulation, body)[:3, 3]
    (x0, x1), (y0, y1) = config.workspace.x, config.workspace.y
    return bool(x0 <= x <= x1 and y0 <= y <= y1 and z > config.table.height_m)


def _drop_again(simulation: Simulation, scene: Scene, config: CellConfig, rng: np.random.Generator) -> None:
    sides = config.workspace.x, config.workspace.y
    for _ in range(_DROP_TRIES):
        lost = [body for body in simulation.bodies if not is_in_workspace(simulation, body, config)]
        if not lost:
            return
        for body in lost:
            x, y = (rng.uniform(0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b) for a, b in sides)
            # A normalised quaternion of normal numbers is a uniform rotation.
            turn = Rotation.from_quat(rng.normal(size=4)).as_quat()
            put_body(simulation, body, [x, y, config.table.height_m + 0.15], turn.tolist())
            _let_fall(simulation, body, config.table.height_m)
            simulation.run(_DROP_STEPS)
        _settle(simulation, scene, config)
    raise ConfigError(
        f"scene {scene.name!r}: its objects keep rolling out of the workspace; use fewer objects or a larger one"
    )


def _let_fall(simulation: Simulation, body: int, table_height_m: float) -> None:
    """Move a body that is about to fall to `_DROP_HEIGHT_M` above whatever is below it now."""
    p, client = simulation.engine, simulation.client
    low, high = p.getAABB(body, physicsClientId=client)
    floor = table_height_m
    for other in simulation.bodies:
        other_low, other_high = p.getAABB(other, physicsClientId=client)
        apart = any(low[i] > other_high[i] or other_low[i] > high[i] for i in (0, 1))
        if other != body and not apart:
            floor = max(floor, other_high[2])
    (x, y, z), turn = p.getBasePositionAndOrientation(body, physicsClientId=client)
    p.resetBasePositionAndOrientation(body, (x, y, z + floor + _DROP_HEIGHT_M - low[2]), turn, physicsClientId=client)
    wake(simulation, body)


def _settle(simulation: Simulation, scene: Scene, config: CellConfig) -> None:
    """Wait until every object rests; the time before the devices are there does not count."""
    quiet = 0
    for _ in range(_SETTLE_SLICES):
        simulation.run(SETTLE_SLICE)
        # What a drop scatters out of the workspace may roll on, or fall off the table; it is dropped again.
        resting = all(
            is_at_rest(simulation, body) or (scene.drop and not is_in_workspace(simulation, body, config))
            for body in simulation.bodies
        )
        quiet = quiet + 1 if resting else 0
        if quiet == QUIET_SLICES:
            return
        if not scene.drop:
            _check_on_table(simulation, scene, config)
    raise ConfigError(f"scene {scene.name!r} does not come to rest: its objects overlap or keep rolling")


def _check_on_table(simulation: Simulation, scene: Scene, config: CellConfig) -> None:
    """Refuse a scene that puts objects where there is no table, or in it."""
    for item, body in zip(scene.objects, simulation.bodies, strict=True):
        x, y, z = object_pose(simulation, body)[:3, 3]
        if z < config.table.height_m:
            raise ConfigError(
                f"scene {scene.name!r}: {item.name!r} fell off the table (x {x:.2f}, y {y:.2f} m): put it on the "
                "table, in metres"
            )
