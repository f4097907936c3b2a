"""What touches arm and gripper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from robotcell.geometry.transforms import Array, cross

if TYPE_CHECKING:
    from sim_twin.world.simulation import Simulation


@dataclass(frozen=True)
class Contact:
    """Where the surroundings touched arm and gripper in the last step, base axes.

    Attributes:
        forces: (N, 3) on arm or gripper [N].
        places: (N, 3) [m].
        on_tool: (N,) whether it is the gripper that is touched.
    """

    forces: Array
    places: Array
    on_tool: npt.NDArray[np.bool_]

    @property
    def robot_force(self) -> Array:
        """(3,) sum of the forces on arm and gripper [N]."""
        return np.asarray(self.forces.sum(axis=0))

    def tool_wrench(self, point: Array) -> Array:
        """(6,) force on the gripper [N] and its torque about a point (3,) [N m]."""
        forces = self.forces[self.on_tool]
        torques = cross(self.places[self.on_tool] - point, forces)
        return np.concatenate([forces.sum(axis=0), torques.sum(axis=0)])


NO_CONTACT = Contact(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_))


def measure_contact(simulation: Simulation) -> Contact:
    """What touched arm and gripper in the last step."""
    points = simulation.engine.getContactPoints(bodyA=simulation.robot, physicsClientId=simulation.client)
    if not points:
        return NO_CONTACT
    # Normal force and two frictions of each contact, each a size and a direction that pushes the robot.
    sizes = np.array([(c[9], c[10], c[12]) for c in points])
    directions = np.array([(c[7], c[11], c[13]) for c in points])
    return Contact(
        forces=np.einsum("ni,nij->nj", sizes, directions),
        places=np.array([c[5] for c in points]),
        on_tool=np.array([c[3] >= simulation.joints["flange"] for c in points]),
    )
