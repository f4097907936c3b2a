"""Force mode: how the tool gives way to a wrench, and in which frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from robotcell.interfaces import Array


@dataclass
class ForceMode:
    """An admittance: along each compliant axis of a frame the tool moves at a speed in proportion to the missing force.

    The real controller also weighs damping and the speed of the contact; this is the simplest law that reaches the
    commanded force against a surface and keeps the commanded limit in free space.

    Attributes:
        R_base_task: (3, 3) axes of the task frame.
        selection: (6,) 1 along the compliant axes.
        wrench: (6,) that the robot shall exert, task axes [N, N m].
        limits: (6,) greatest speed along the compliant axes [m/s, rad/s]; the others are position controlled.
        gain: force_mode_set_gain_scaling.
    """

    R_base_task: Array
    selection: Array
    wrench: Array
    limits: Array
    gain: float

    # Speed per force and per torque at gain 1: 50 N missing move the tool at 0.05 m/s. Assumed.
    _MOBILITY = np.array([1e-3, 1e-3, 1e-3, 2e-2, 2e-2, 2e-2])

    def twist(self, measured: Array) -> Array:
        """(6,) speed [m/s, rad/s] in base axes, of the wrench (6,) that the surroundings exert, base axes."""
        R = self.R_base_task
        task = np.concatenate([R.T @ measured[:3], R.T @ measured[3:]])
        speed = self.gain * self._MOBILITY * (self.wrench + task)
        speed = np.clip(speed, -np.abs(self.limits), np.abs(self.limits)) * (self.selection != 0)
        return np.concatenate([R @ speed[:3], R @ speed[3:]])


def towards_origin(frame: Array, tool: Array) -> Array:
    """The axes (3, 3) of a task frame of type 1: y points from the tool to the frame's origin, the others stay near.

    Args:
        frame: T_base_task (4, 4) as the program gives it.
        tool: (3,) the tool [m], base axes.
    """
    y = frame[:3, 3] - tool
    length = float(np.linalg.norm(y))
    if length == 0:
        return frame[:3, :3]
    y = y / length
    x = np.cross(y, frame[:3, 2])
    x = x / max(float(np.linalg.norm(x)), 1e-9)
    return np.column_stack([x, y, np.cross(x, y)])


def along_motion(frame: Array, speed: Array) -> Array:
    """The axes (3, 3) of a task frame of type 3: x points along the tool's motion in the frame's x-y plane.

    Args:
        frame: T_base_task (4, 4) as the program gives it.
        speed: (3,) of the tool [m/s], base axes.
    """
    axes = frame[:3, :3]
    x = speed - axes[:, 2] * float(speed @ axes[:, 2])
    length = float(np.linalg.norm(x))
    if length == 0:
        return axes
    x = x / length
    return np.column_stack([x, np.cross(axes[:, 2], x), axes[:, 2]])
