"""The driver of the RG2.

Widths are between the finger tips: the box's "width with fingertip offset", which is the width between the bare
fingers less what the mounted tips take.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from robotcell.drivers.rg2.compute_box import BoxState, ComputeBox
from robotcell.drivers.unconfirmed import warn_unconfirmed
from robotcell.errors import ConnectionLost, DeviceFault, UnsafeMotion
from robotcell.geometry import rg2
from robotcell.interfaces import Gripper, GripperRange, GripperState

if TYPE_CHECKING:
    from robotcell.interfaces import Clock

# The box rounds widths to 0.1 mm: an offset that it took is within half of that, and a little for the arithmetic.
_SAME_OFFSET_M = 0.00006
# Fingers this close to the commanded width have reached it.
_REACHED_M = 0.001
# Fingers that rest further away than this, and hold nothing, did not go where they were sent. Assumed.
_ASTRAY_M = 0.003
# Within this time of a command fingers that rest may not have begun to move. Assumed.
_START_S = 0.05
# Fingers that are told to stop do so within this. Assumed.
_STOP_S = 0.5
_POLL_S = 0.01


class RG2Options(BaseModel):
    """`gripper` of a hardware cell.

    Attributes:
        host: address of the Compute Box.
        port: of its Modbus server.
        unit: 65 behind a Quick Changer or HEX, 66 and 67 on a Dual Quick Changer.
        fingertip_offset_m: how far each mounted tip reaches inwards from the bare aluminium finger; set in the box at
            connect.
        timeout_s: after which a box that does not answer counts as lost.
        power_cycle_timeout_s: within which a gripper must be back after a power cycle. Assumed: 1 to 2 s are usual.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    host: str = "192.168.1.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    unit: Annotated[int, Field(ge=1, le=247)] = 65
    fingertip_offset_m: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0
    timeout_s: Annotated[float, Field(ge=0.05, le=0.5)] = 0.4
    power_cycle_timeout_s: Annotated[float, Field(ge=1.0, le=30.0)] = 5.0


class RG2(Gripper):
    """A `Gripper`. Never repeats a command by itself; a link that was lost comes back by `connect` only.

    Args:
        options: where it is.
        clock: of the cell.
    """

    def __init__(self, options: RG2Options, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._box = ComputeBox(options.host, options.port, options.unit, options.timeout_s)
        # With the tips that the box says are mounted.
        self._range = rg2.range_with_tips(options.fingertip_offset_m)
        # The last command (width [m], force [N]) and when it was given; None after a stop.
        self._command: tuple[float, float] | None = None
        self._commanded_at = -math.inf

    def connect(self) -> None:
        """Open the link, check that an RG2 is there and free to move, and set its fingertip offset.

        Raises:
            ConnectionLost: the box or its gripper cannot be reached.
            DeviceFault: it is no RG2, a safety switch has tripped, or it does not take the offset.
            ConfigError: pymodbus is not installed.
        """
        if self._box.is_open:
            return
        warn_unconfirmed("RG2")
        self._box.open()
        try:
            product = self._box.product()
            if product != "RG2":
                raise self._refusal(f"the gripper is {product}, not an RG2; correct gripper.unit or the driver")
            self._set_offset()
            self._range = rg2.range_with_tips(self._free_state().offset_m)
            self._command = None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop fingers that move, and close the link. Idempotent, never raises."""
        try:
            if self._box.is_open and self._command is not None and self._box.state().busy:
                self._box.stop()
        except (ConnectionLost, DeviceFault):
            pass
        self._command = None
        self._box.close()

    def state(self) -> GripperState:
        """What the box reports, within the time-out of one answer.

        Raises:
            ConnectionLost: it does not answer.
            DeviceFault: a safety switch has tripped, the offset is not the one that was set, or the fingers did not go
                where they were sent.
        """
        t = self._clock.now()
        state = self._free_state()
        self._check_offset(state)
        width, busy, grip = max(state.tip_width_m, 0.0), state.busy, state.grip
        if self._command is not None:
            astray = abs(width - self._command[0])
            starting = t - self._commanded_at < _START_S
            busy = busy or (starting and astray > _REACHED_M)
            if not busy and not grip and astray > _ASTRAY_M:
                raise self._refusal(
                    f"the fingers rest {1000 * width:.1f} mm apart, were sent to {1000 * self._command[0]:.1f} mm, and "
                    "the box reports neither motion nor grip; see what blocks them, then power-cycle the gripper"
                )
            grip = grip and astray > _REACHED_M
        return GripperState(t=t, width_m=width, busy=busy, grip_detected=grip and not busy)

    def range(self) -> GripperRange:
        """What the box says that the gripper reaches with its tips; see `Gripper`.

        Raises:
            ConnectionLost: the gripper is not connected.
        """
        self._box.need_link()
        return self._range

    def start_width(self, width_m: float, force_n: float) -> None:
        """Start moving the fingers; see `Gripper`. Fingers on their way to elsewhere are stopped first.

        Raises:
            ConnectionLost: the box does not answer; whether it took the command is not known.
            DeviceFault: a safety switch has tripped, the fingers do not stop, or the box refuses.
            UnsafeMotion: width or force are outside the gripper's range.
        """
        self._box.need_link()
        reach = self._range
        _check_range("width", 1000 * width_m, 1000 * reach.min_width_m, 1000 * reach.max_width_m, "mm")
        _check_range("force", force_n, reach.min_force_n, reach.max_force_n, "N")
        if self._free_state().busy:
            if self._command == (width_m, force_n):
                return
            # The box ignores a grip while it is busy.
            self._stop_and_wait()
        self._box.grip(width_m, force_n)
        self._command, self._commanded_at = (width_m, force_n), self._clock.now()

    def stop(self) -> None:
        """Stop the fingers where they are.

        Raises:
            ConnectionLost: the box does not answer.
        """
        self._box.stop()
        self._command = None

    def firmware(self) -> str:
        """Version of the gripper's firmware: major.minor, build.

        Raises:
            ConnectionLost: the box does not answer.
        """
        return self._box.firmware()

    def recover(self) -> None:
        """Power-cycle the gripper, which resets a safety switch that tripped. Only because an operator asked for it.

        Works also where `connect` refuses. A gripper that is free to move is left as it is; one that was connected
        is connected again.

        Raises:
            ConnectionLost: the box cannot be reached, or its gripper does not come back.
            DeviceFault: a switch is still pushed.
        """
        connected = self._box.is_open
        if not connected:
            self._box.open()
        try:
            if self._box.state().fault:
                self._box.power_cycle()
                self._wait_for_power()
        finally:
            self._command = None
            self._box.close()
        if connected:
            self.connect()

    def _free_state(self) -> BoxState:
        """What the box reports.

        Raises:
            DeviceFault: the gripper is not free to move.
        """
        state = self._box.state()
        if state.fault:
            raise self._refusal(state.fault)
        return state

    def _set_offset(self) -> None:
        if abs(self._box.state().offset_m - self._options.fingertip_offset_m) > _SAME_OFFSET_M:
            self._box.set_offset(self._options.fingertip_offset_m)
            self._check_offset(self._box.state())

    def _check_offset(self, state: BoxState) -> None:
        wanted_m = self._options.fingertip_offset_m
        if abs(state.offset_m - wanted_m) > _SAME_OFFSET_M:
            raise self._refusal(
                f"its fingertip offset is {1000 * state.offset_m:.1f} mm, the cell's is {1000 * wanted_m:.1f} mm; see "
                "who else sets it, then connect again"
            )

    def _stop_and_wait(self) -> None:
        self.stop()
        end = self._clock.now() + _STOP_S
        while self._box.state().busy:
            if self._clock.now() > end:
                raise self._refusal(f"still busy {_STOP_S:g} s after it was told to stop; power-cycle the gripper")
            self._clock.sleep(_POLL_S)

    def _wait_for_power(self) -> None:
        """Wait until the gripper answers again and is free to move."""
        end = self._clock.now() + self._options.power_cycle_timeout_s
        while True:
            try:
                if not self._box.is_open:
                    self._box.open()
                self._free_state()
                return
            except (ConnectionLost, DeviceFault):
                if self._clock.now() > end:
                    raise
            self._clock.sleep(_POLL_S)

    def _refusal(self, what: str) -> DeviceFault:
        return DeviceFault(f"{self._box.place}: {what}", device="gripper")


def _check_range(what: str, value: float, low: float, high: float, unit: str) -> None:
    if not math.isfinite(value) or not low - 1e-9 <= value <= high + 1e-9:
        raise UnsafeMotion(
            f"gripper {what} {value:g} {unit} is outside the RG2's range of {low:g} to {high:g} {unit}",
            device="gripper",
        )
