"""The twin's RG2: two coupled cranks driven at a constant tip speed with a torque that gives the commanded force."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from robotcell.errors import ConnectionLost, UnsafeMotion
from robotcell.geometry import rg2
from robotcell.interfaces import Gripper, GripperRange, GripperState
from sim_twin.world import robot_model
from sim_twin.world.simulation import STEP_S

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array
    from sim_twin.world.world import World

# Of the opening: the whole stroke in a second. Assumed.
WIDTH_SPEED_M_S = 0.11
# The fingers are where they should be within this.
_REACHED_M = 0.0002
# Stopped short of the commanded width by more than this, the fingers hold something.
GRIP_TOLERANCE_M = 0.001
# Over so many steps, fingers that got less far than this were stopped; if further than that, they are free again.
# In between, what is held creeps or gives way a little. Judged by the way, since gripped fingers tremble.
_WINDOW_STEPS = 16
_STILL_M = 0.0003
_FREE_M = 0.002
# The worm drive cannot be pushed back: at rest the cranks hold with this torque.
_HOLDING_TORQUE_NM = 20.0
# Share of the remaining way that the fingers may cover within a step, so that they do not overshoot.
_APPROACH = 0.3


class TwinGripper(Gripper):
    """The `Gripper` of a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._connected = False
        self._range = world.gripper_range
        self._cranks: list[int] = []
        self._target_m = 0.0
        self._force_n = 0.0
        self._driving = False
        # Steps since the fingers were last judged, and where they were then.
        self._judged_steps = 0
        self._judged_width_m = 0.0
        self._stopped = False

    def connect(self) -> None:
        """Attach to the world and hold the fingers where they are. Does nothing when connected."""
        if self._connected:
            return
        try:
            self._world.attach(self)
            self._cranks = self._world.joint_index((robot_model.LEFT_CRANK, robot_model.RIGHT_CRANK))
            self._connected = True
            self.stop()
            self._world.add_controller(self._control)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the fingers and let the world go. Idempotent, also when connecting was cut short."""
        if self._connected:
            self.stop()
        self._connected = False
        self._world.remove_controller(self._control)
        self._world.detach(self)

    def state(self) -> GripperState:
        """The state after the last step."""
        self._need_connection()
        width = self._width(self._world.joint_states(self._cranks)[0])
        return GripperState(
            t=self._world.time_s,
            width_m=max(width, self._range.min_width_m),
            busy=self._driving and not self._stopped,
            grip_detected=self._driving and self._stopped and abs(width - self._target_m) > GRIP_TOLERANCE_M,
        )

    def range(self) -> GripperRange:
        """What it reaches with its tips; see `Gripper`."""
        self._need_connection()
        return self._range

    def start_width(self, width_m: float, force_n: float) -> None:
        """Start moving the fingers; see `Gripper`.

        Raises:
            UnsafeMotion: width or force are outside the RG2's range.
        """
        self._need_connection()
        reach = self._range
        _check_range("width", 1000 * width_m, 1000 * reach.min_width_m, 1000 * reach.max_width_m, "mm")
        _check_range("force", force_n, reach.min_force_n, reach.max_force_n, "N")
        if (width_m, force_n) != (self._target_m, self._force_n):
            self._target_m, self._force_n = width_m, force_n
            self._forget_motion()
            self._driving = True

    def stop(self) -> None:
        """Hold the fingers where they are."""
        self._need_connection()
        angles, _ = self._world.joint_states(self._cranks)
        self._target_m = min(max(self._width(angles), self._range.min_width_m), self._range.max_width_m)
        self._force_n = 0.0
        self._hold()

    def recover(self) -> None:
        """Nothing to leave: the simulated fingers have no safety switches."""

    def _control(self) -> None:
        """One control period: drive the cranks towards the commanded width."""
        if not self._driving:
            return
        angles, _ = self._world.joint_states(self._cranks)
        width, angle = self._width(angles), float(angles.mean())
        way = self._target_m - width
        if abs(way) < _REACHED_M:
            self._hold()
            return
        # Half the opening changes by L cos(angle) per radian, so a tip force F needs the torque F L cos(angle).
        lever = rg2.CRANK_LENGTH_M * math.cos(angle)
        speed = math.copysign(min(WIDTH_SPEED_M_S, _APPROACH * abs(way) / STEP_S), way)
        self._world.drive_speeds(self._cranks, (speed / (2 * lever),) * 2, (self._force_n * lever,) * 2)
        self._judge(width)

    def _judge(self, width_m: float) -> None:
        """Tell fingers that something stopped from fingers that move."""
        self._judged_steps += 1
        if self._judged_steps < _WINDOW_STEPS:
            return
        way = abs(width_m - self._judged_width_m)
        if way < _STILL_M:
            self._stopped = True
        elif way > _FREE_M:
            self._stopped = False
        self._judged_steps, self._judged_width_m = 0, width_m

    def _forget_motion(self) -> None:
        self._judged_steps = 0
        self._judged_width_m = self._width(self._world.joint_states(self._cranks)[0])
        self._stopped = False

    def _hold(self) -> None:
        self._driving = False
        self._forget_motion()
        angle = rg2.crank_angle(self._target_m + 2 * self._range.fingertip_offset_m)
        self._world.drive_positions(self._cranks, (angle,) * 2, (_HOLDING_TORQUE_NM,) * 2, (0.5,) * 2)

    def _width(self, angles: Array) -> float:
        """Between the tips [m]."""
        bare = 0.5 * sum(rg2.width_at(float(angle)) for angle in angles)
        return bare - 2 * self._range.fingertip_offset_m

    def _need_connection(self) -> None:
        if not self._connected:
            raise ConnectionLost("the twin's gripper is not connected: connect it first")


def _check_range(what: str, value: float, low: float, high: float, unit: str) -> None:
    if not math.isfinite(value) or not low - 1e-9 <= value <= high + 1e-9:
        raise UnsafeMotion(f"gripper {what} {value:g} {unit} is outside the RG2's range of {low:g} to {high:g} {unit}")
