"""The OnRobot RG2 behind a Compute Box, over Modbus TCP.

Registers after OnRobot's "Connectivity Guide for Modbus RTU and TCP". Widths are between the finger tips: the box's
"width with fingertip offset", which is the width between the bare fingers less what the mounted tips take.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NoReturn

from pydantic import BaseModel, ConfigDict, Field

from robotcell.drivers.unconfirmed import warn_unconfirmed
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault, UnsafeMotion
from robotcell.geometry import rg2
from robotcell.interfaces import Gripper, GripperState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pymodbus.client import ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

    from robotcell.interfaces import Clock

_COMMAND, _CONTROL, _SET_OFFSET, _PRODUCT, _FIRMWARE = 0, 2, 1031, 1536, 1540
# From the fingertip offset to the width with offset, in one read: all of one moment.
_STATE = range(258, 276)
_OFFSET, _BARE_WIDTH, _STATUS, _TIP_WIDTH = 258, 267, 268, 275
_STOP, _GRIP_WITH_OFFSET = 8, 16
_BUSY, _GRIP, _SAFETY_ERROR = 1 << 0, 1 << 1, 1 << 6
_TRIPPED = {"S1": 1 << 3, "S2": 1 << 5}
_PUSHED = {"S1": 1 << 2, "S2": 1 << 4}
_PRODUCTS = {0x20: "RG2", 0x21: "RG6", 0x22: "RG2-FT"}
# The Compute Box itself, and what switches its tool off and on again (1 to 2 s).
_BOX_UNIT, _POWER_CYCLE = 63, 2
_POWER_CYCLE_S = 5.0

# The box's own unit of length and of force is a tenth of a millimetre and of a newton.
_PER_M, _PER_N = 10_000, 10
# Fingers this close to the commanded width have reached it.
_REACHED_M = 0.001
# Fingers that rest further away than this, and hold nothing, did not go where they were sent. Assumed.
_ASTRAY_M = 0.003
# Within this time of a command fingers that rest may not have begun to move. Assumed.
_START_S = 0.05
# Fingers that are told to stop do so within this. Assumed.
_STOP_S = 0.5
_POLL_S = 0.01

_NOT_CONNECTED = "not connected; connect it first"

# Where nobody listens to its logger, the library would write every failed request to stderr.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


class RG2Options(BaseModel):
    """`gripper` of a hardware cell.

    Attributes:
        host: address of the Compute Box.
        port: of its Modbus server.
        unit: 65 behind a Quick Changer or HEX, 66 and 67 on a Dual Quick Changer.
        fingertip_offset_m: how far each mounted tip reaches inwards from the bare aluminium finger; set in the box at
            connect.
        timeout_s: after which a box that does not answer counts as lost.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    host: str = "192.168.1.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    unit: Annotated[int, Field(ge=1, le=247)] = 65
    fingertip_offset_m: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0
    timeout_s: Annotated[float, Field(ge=0.05, le=0.5)] = 0.4


@dataclass(frozen=True)
class _Registers:
    """What the box reports, in its units."""

    status: int
    offset: int
    bare_width: int
    tip_width: int


class RG2(Gripper):
    """A `Gripper`. Never repeats a command by itself; a link that was lost comes back by `connect` only.

    Args:
        options: where it is.
        clock: of the cell.
    """

    def __init__(self, options: RG2Options, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._client: ModbusTcpClient | None = None
        self._why_closed = _NOT_CONNECTED
        # Whether anything came back since the last request.
        self._heard = False
        # Between the tips [m]; the tips shift the range of the bare fingers.
        self._range_m = (rg2.MIN_WIDTH_M, rg2.MAX_WIDTH_M)
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
        if self._client is not None:
            return
        warn_unconfirmed("RG2")
        self._open()
        try:
            (product,) = self._read(_PRODUCT, 1, "its product code")
            if _PRODUCTS.get(product) != "RG2":
                found = _PRODUCTS.get(product, f"an unknown device ({product:#x})")
                raise DeviceFault(
                    f"{self._place}: the gripper is {found}, not an RG2; correct gripper.unit or the driver"
                )
            self._set_offset()
            registers = self._registers()
            self._check_free(registers)
            shift = registers.tip_width - registers.bare_width
            low, high = round(rg2.MIN_WIDTH_M * _PER_M) + shift, round(rg2.MAX_WIDTH_M * _PER_M) + shift
            # The register of the width takes no more with tips that reach outwards.
            self._range_m = max(0, low) / _PER_M, min(high / _PER_M, rg2.MAX_WIDTH_M)
            self._command = None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop fingers that move, and close the link. Idempotent, never raises."""
        try:
            if self._client is not None and self._command is not None and self._registers().status & _BUSY:
                self._write(_CONTROL, [_STOP], "to stop")
        except (ConnectionLost, DeviceFault):
            pass
        self._hang_up(_NOT_CONNECTED)

    def state(self) -> GripperState:
        """What the box reports, within the time-out of one answer.

        Raises:
            ConnectionLost: it does not answer.
            DeviceFault: a safety switch has tripped, the offset is not the one that was set, or the fingers did not go
                where they were sent.
        """
        t = self._clock.now()
        registers = self._registers()
        self._check_free(registers)
        self._check_offset(registers.offset)
        width = max(registers.tip_width, 0) / _PER_M
        busy, grip = bool(registers.status & _BUSY), bool(registers.status & _GRIP)
        if self._command is not None:
            astray = abs(width - self._command[0])
            starting = t - self._commanded_at < _START_S
            busy = busy or (starting and astray > _REACHED_M)
            if not busy and not grip and astray > _ASTRAY_M:
                raise DeviceFault(
                    f"{self._place}: the fingers rest {1000 * width:.1f} mm apart, were sent to "
                    f"{1000 * self._command[0]:.1f} mm, and the box reports neither motion nor grip; see what blocks "
                    "them, then power-cycle the gripper"
                )
            grip = grip and astray > _REACHED_M
        return GripperState(t=t, width_m=width, busy=busy, grip_detected=grip and not busy)

    def start_width(self, width_m: float, force_n: float) -> None:
        """Start moving the fingers; see `Gripper`. Fingers on their way to elsewhere are stopped first.

        Raises:
            ConnectionLost: the box does not answer; whether it took the command is not known.
            DeviceFault: a safety switch has tripped, the fingers do not stop, or the box refuses.
            UnsafeMotion: width or force are outside the gripper's range.
        """
        self._need_link()
        _check_range("width", 1000 * width_m, 1000 * self._range_m[0], 1000 * self._range_m[1], "mm")
        _check_range("force", force_n, rg2.MIN_FORCE_N, rg2.MAX_FORCE_N, "N")
        registers = self._registers()
        self._check_free(registers)
        if registers.status & _BUSY:
            if self._command == (width_m, force_n):
                return
            # The box ignores a grip while it is busy.
            self._stop_and_wait()
        self._write(_COMMAND, [round(force_n * _PER_N), round(width_m * _PER_M), _GRIP_WITH_OFFSET], "a width to go to")
        self._command, self._commanded_at = (width_m, force_n), self._clock.now()

    def stop(self) -> None:
        """Stop the fingers where they are.

        Raises:
            ConnectionLost: the box does not answer.
        """
        self._write(_CONTROL, [_STOP], "to stop")
        self._command = None

    def firmware(self) -> str:
        """Version of the gripper's firmware: major.minor, build.

        Raises:
            ConnectionLost: the box does not answer.
        """
        version, build = self._read(_FIRMWARE, 2, "its firmware")
        return f"{version >> 8}.{version & 0xFF}, build {build}"

    def recover(self) -> None:
        """Power-cycle the gripper, which resets a safety switch that tripped. Only because an operator asked for it.

        Works also where `connect` refuses. A gripper that is free to move is left as it is; one that was connected
        is connected again.

        Raises:
            ConnectionLost: the box cannot be reached, or its gripper does not come back.
            DeviceFault: a switch is still pushed.
        """
        connected = self._client is not None
        if not connected:
            self._open()
        try:
            if self._fault(self._registers()):
                self._write(0, [_POWER_CYCLE], "a power cycle", _BOX_UNIT)
                self._wait_for_power()
        finally:
            self._hang_up(_NOT_CONNECTED)
        if connected:
            self.connect()

    @property
    def _place(self) -> str:
        return f"gripper at {self._options.host}:{self._options.port}, unit {self._options.unit}"

    def _open(self) -> None:
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError as error:
            raise ConfigError(f"pymodbus cannot be imported ({error}): pip install 'robotcell[hardware]'") from error
        options = self._options
        # A motion that is sent twice is done twice.
        client = ModbusTcpClient(
            options.host, port=options.port, timeout=options.timeout_s, retries=0, trace_packet=self._hear
        )
        if not client.connect():  # type: ignore[no-untyped-call]
            raise ConnectionLost(
                f"{self._place}: nothing answers there; check the Compute Box's power, its cable and its address"
            )
        self._client = client

    def _hear(self, sending: bool, data: bytes) -> bytes:
        self._heard = not sending
        return data

    def _set_offset(self) -> None:
        wanted = round(self._options.fingertip_offset_m * _PER_M)
        if self._registers().offset != wanted:
            self._write(_SET_OFFSET, [wanted & 0xFFFF], "its fingertip offset")
            self._check_offset(self._registers().offset)

    def _check_offset(self, offset: int) -> None:
        wanted = round(self._options.fingertip_offset_m * _PER_M)
        if offset != wanted:
            raise DeviceFault(
                f"{self._place}: its fingertip offset is {offset / 10:.1f} mm, the cell's is {wanted / 10:.1f} mm; see "
                "who else sets it, then connect again"
            )

    def _stop_and_wait(self) -> None:
        self.stop()
        end = self._clock.now() + _STOP_S
        while self._registers().status & _BUSY:
            if self._clock.now() > end:
                raise DeviceFault(
                    f"{self._place}: still busy {_STOP_S:g} s after it was told to stop; power-cycle the gripper"
                )
            self._clock.sleep(_POLL_S)

    def _wait_for_power(self) -> None:
        """Wait until the gripper answers again and is free to move."""
        end = self._clock.now() + _POWER_CYCLE_S
        while True:
            try:
                if self._client is None:
                    self._open()
                self._check_free(self._registers())
                return
            except (ConnectionLost, DeviceFault):
                if self._clock.now() > end:
                    raise
            self._clock.sleep(_POLL_S)

    def _check_free(self, registers: _Registers) -> None:
        fault = self._fault(registers)
        if fault:
            raise DeviceFault(f"{self._place}: {fault}")

    def _fault(self, registers: _Registers) -> str:
        """What keeps the gripper from moving, and its cure; empty if nothing does."""
        status = registers.status
        tripped = [name for name, bit in _TRIPPED.items() if status & bit]
        if not tripped and not status & _SAFETY_ERROR:
            return ""
        pushed = [name for name, bit in _PUSHED.items() if status & bit]
        what = f"safety switch {' and '.join(tripped)} has tripped" if tripped else "safety error at power on"
        first = f"free switch {' and '.join(pushed)}, which is still pushed" if pushed else "see what pushed the switch"
        return f"{what}, it will not move; {first}, then power-cycle it with `robotcell recover` or at the tool changer"

    def _registers(self) -> _Registers:
        values = dict(zip(_STATE, self._read(_STATE.start, len(_STATE), "its state"), strict=True))
        return _Registers(
            status=values[_STATUS],
            offset=_signed(values[_OFFSET]),
            bare_width=_signed(values[_BARE_WIDTH]),
            tip_width=_signed(values[_TIP_WIDTH]),
        )

    def _read(self, address: int, count: int, what: str) -> Sequence[int]:
        unit = self._options.unit
        registers = self._ask(
            lambda client: client.read_holding_registers(address, count=count, device_id=unit),
            f"asked for {what}",
            unit,
        ).registers
        if len(registers) != count:
            self._lose(f"asked for {what}, answered with {len(registers)} registers for {count}: restart the box")
        return registers

    def _write(self, address: int, values: list[int], what: str, unit: int | None = None) -> None:
        to = self._options.unit if unit is None else unit
        self._ask(lambda client: client.write_registers(address, values, device_id=to), f"told {what}", to)

    def _ask(self, request: Callable[[ModbusTcpClient], ModbusPDU], what: str, unit: int) -> ModbusPDU:
        """One request and its answer."""
        from pymodbus.exceptions import ConnectionException

        client = self._need_link()
        try:
            response = request(client)
        except (ConnectionException, OSError):
            self._lose(f"{what}, hung up; it serves one client at a time: close other connections, then connect again")
        except Exception as error:  # bytes that mean nothing make the library fail in many ways
            if self._heard:
                self._lose(f"{what}, answered with bytes that are no Modbus ({error}): check what is at that address")
            self._lose(
                f"{what}, gave no answer in {self._options.timeout_s:g} s; check its link, that unit {unit} is right "
                "(65 Quick Changer, 66 or 67 Dual Quick Changer), and that the gripper has power, then connect again"
            )
        if response.isError():
            code = response.exception_code
            raise DeviceFault(
                f"{self._place}: {what}, refused with Modbus exception {code} ({_EXCEPTIONS.get(code, 'unknown')}); "
                "check which gripper and which firmware the Compute Box has"
            )
        return response

    def _need_link(self) -> ModbusTcpClient:
        if self._client is None:
            raise ConnectionLost(f"{self._place}: {self._why_closed}")
        return self._client

    def _lose(self, what: str) -> NoReturn:
        self._hang_up("the link was lost; connect again")
        raise ConnectionLost(f"{self._place}: {what}")

    def _hang_up(self, why: str) -> None:
        client, self._client = self._client, None
        self._command = None
        self._why_closed = why
        if client is not None:
            client.close()  # type: ignore[no-untyped-call]


_EXCEPTIONS = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal value",
    4: "device failure",
    6: "device busy",
    10: "no path to the gripper",
    11: "the gripper does not respond",
}


def _signed(register: int) -> int:
    """Of a two's complement of 16 bits."""
    return register - 0x10000 if register & 0x8000 else register


def _check_range(what: str, value: float, low: float, high: float, unit: str) -> None:
    if not math.isfinite(value) or not low - 1e-9 <= value <= high + 1e-9:
        raise UnsafeMotion(f"gripper {what} {value:g} {unit} is outside the RG2's range of {low:g} to {high:g} {unit}")
