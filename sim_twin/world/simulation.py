"""The running engine of a world, and what is loaded in it.

Settings by experiment (240 Hz, 50 solver iterations, gear constraint, rolling friction, maximal coordinates and
sleeping for objects): docs/explanation/twin.md lists them with what they are good for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from robotcell.errors import ConnectionLost
from sim_twin.world.engine import load_pybullet

STEP_S = 1 / 240
GRAVITY_M_S2 = 9.81

_SOLVER_ITERATIONS = 50
# Solving ends early when a further iteration would change less than this; 30 objects then cost a tenth less.
_SOLVER_RESIDUAL = 1e-4
# Half the engine's default. It also widens the boxes by which the engine finds neighbours, and all objects whose boxes
# touch wake together: with the default the gripper wakes the whole table when it comes near one object.
_CONTACT_BREAKING_M = 0.01


@dataclass
class Simulation:
    """What exists while the engine runs.

    Attributes:
        engine: the module pybullet.
        client: number of the world within it.
        robot: number of the body of arm and gripper; -1 before it is loaded.
        joints: the engine's numbers of its joints, by the names in `robot_model`.
        bodies: numbers of the bodies of the scene's objects.
    """

    engine: Any
    client: int
    robot: int = -1
    joints: dict[str, int] = field(default_factory=dict)
    bodies: list[int] = field(default_factory=list)

    def run(self, steps: int) -> None:
        """Advance by so many steps of `STEP_S`."""
        for _ in range(steps):
            self.engine.stepSimulation(self.client)

    def end(self) -> None:
        """End the engine's world."""
        self.engine.disconnect(physicsClientId=self.client)


def start_simulation() -> Simulation:
    """An empty world.

    Raises:
        ConnectionLost: too many are open in this process.
    """
    pybullet = load_pybullet()
    client = pybullet.connect(pybullet.DIRECT)
    if client < 0:
        raise ConnectionLost("the physics engine could not be started: too many worlds are open in this process")
    pybullet.setGravity(0, 0, -GRAVITY_M_S2, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=STEP_S,
        numSolverIterations=_SOLVER_ITERATIONS,
        solverResidualThreshold=_SOLVER_RESIDUAL,
        contactBreakingThreshold=_CONTACT_BREAKING_M,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
        physicsClientId=client,
    )
    return Simulation(pybullet, client)
