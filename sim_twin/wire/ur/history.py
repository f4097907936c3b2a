"""What was measured during the last second: for the detection of contacts, and for going back to one."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.interfaces import Array

_PERIODS = 500
# A force on the tool that counts as contact. Assumed; the real detection also looks at the motor currents.
_CONTACT_FORCE_N = 10.0


class History:
    """Joint angles (6,) and forces on the tool (3,), one of each per control period, newest last.

    Args:
        q: (6,) joint angles [rad] at the start.
    """

    def __init__(self, q: Array) -> None:
        self._joints: deque[Array] = deque([q], maxlen=_PERIODS)
        self._forces: deque[Array] = deque([np.zeros(3)], maxlen=_PERIODS)

    def add(self, q: Array, force_n: Array) -> None:
        """Keep what was measured in this period."""
        self._joints.append(q)
        self._forces.append(force_n)

    def contact_steps(self, direction: Sequence[float]) -> int:
        """How many periods ago the tool came into contact; 0 when it is free. tool_contact.

        Args:
            direction: (at least 3) base axes, against which a contact pushes; zeros for any.
        """
        axis = np.array(direction[:3], dtype=np.float64)
        length = float(np.linalg.norm(axis))
        steps = 0
        for force in reversed(self._forces):
            size = -float(force @ axis) / length if length > 0 else float(np.linalg.norm(force))
            if size < _CONTACT_FORCE_N:
                break
            steps += 1
        return steps

    def joints_before(self, steps: int) -> Array:
        """Joint angles (6,) measured some periods ago. get_actual_joint_positions_history."""
        return self._joints[max(-1 - max(steps, 0), -len(self._joints))]
