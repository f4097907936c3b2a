"""The Compute Box: one Modbus TCP link to it, the registers of the RG2 behind it, and its failures in the cell's words.

Registers after OnRobot's "Connectivity Guide for Modbus RTU and TCP".
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

from robotcell.errors import ConfigError, ConnectionLost, DeviceFault

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pymodbus.client import ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

NOT_CONNECTED = "not connected; connect it first"

_COMMAND, _CONTROL, _SET_OFFSET, _PRODUCT, _FIRMWARE = 0, 2, 1031, 1536, 1540
# From the fingertip offset to the width with offset, in one read: all of one moment.
_STATE = range(258, 276)
_OFFSET, _BARE_WIDTH, _STATUS, _TIP_WIDTH = 258, 267, 268, 275
_STOP, _GRIP_WITH_OFFSET = 8, 16
_BUSY, _GRIP, _SAFETY_ERROR = 1 << 0, 1 << 1, 1 << 6
_TRIPPED = {"S1": 1 << 3, "S2": 1 << 5}
_PUSHED = {"S1": 1 << 2, "S2": 1 << 4}
_PRODUCTS = {0x20: "RG2", 0x21: "RG6", 0x22: "RG2-FT"}
# The Compute Box itself, and what switches its tool off and on again.
_BOX_UNIT, _POWER_CYCLE = 63, 2
# Responses have 260 bytes at most; late ones of earlier requests may come before.
_LONGEST_RESPONSE = 1 << 16
# The box's own unit of length and of force is a tenth of a millimetre and of a newton.
_PER_M, _PER_N = 10_000, 10
_EXCEPTIONS = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal value",
    4: "device failure",
    6: "device busy",
    10: "no path to the gripper",
    11: "the gripper does not respond",
}

# Where nobody listens to its logger, the library would write every failed request to stderr.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class BoxState:
    """What the box reports of the gripper at one moment.

    Attributes:
        busy: the fingers move.
        grip: something between the fingers stopped them.
        offset_m: how far each mounted tip reaches inwards from the bare finger.
        bare_width_m: between the bare fingers.
        tip_width_m: between the tips.
        fault: what keeps the gripper from moving, and its cure; empty if nothing does.
    """

    busy: bool
    grip: bool
    offset_m: float
    bare_width_m: float
    tip_width_m: float
    fault: str


class ComputeBox:
    """A link to the box. Never repeats a request; a link that was lost comes back by `open` only.

    Every request raises ConnectionLost where the link is not open or breaks, and DeviceFault where the box refuses.

    Args:
        host: address of the box.
        port: of its Modbus server.
        unit: number of the gripper.
        timeout_s: after which a box that does not answer counts as lost.
    """

    def __init__(self, host: str, port: int, unit: int, timeout_s: float) -> None:
        self._host = host
        self._port = port
        self._unit = unit
        self._timeout_s = timeout_s
        self._client: ModbusTcpClient | None = None
        self._why_closed = NOT_CONNECTED
        # Whether anything came back since the last request.
        self._heard = False

    @property
    def place(self) -> str:
        """Where it is, for messages."""
        return f"gripper at {self._host}:{self._port}, unit {self._unit}"

    @property
    def is_open(self) -> bool:
        """Whether there is a link."""
        return self._client is not None

    def open(self) -> None:
        """Open the link.

        Raises:
            ConnectionLost: nothing answers there.
            ConfigError: pymodbus is not installed.
        """
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError as error:
            raise ConfigError(
                f"pymodbus cannot be imported ({error}): pip install 'robotcell[hardware]'", device="gripper"
            ) from error
        # A motion that is sent twice is done twice.
        client = ModbusTcpClient(
            self._host, port=self._port, timeout=self._timeout_s, retries=0, trace_packet=self._hear
        )
        if not client.connect():  # type: ignore[no-untyped-call]
            raise ConnectionLost(
                f"{self.place}: nothing answers there; check the Compute Box's power, its cable and its address",
                device="gripper",
            )
        self._client = client

    def close(self, why: str = NOT_CONNECTED) -> None:
        """Close the link; `why` is what later requests say. Idempotent."""
        client, self._client = self._client, None
        self._why_closed = why
        if client is not None:
            client.close()  # type: ignore[no-untyped-call]

    def need_link(self) -> None:
        """Raise ConnectionLost if the link is not open."""
        self._need_client()

    def product(self) -> str:
        """Name of the device behind the box."""
        (product,) = self._read(_PRODUCT, 1, "its product code")
        return _PRODUCTS.get(product, f"an unknown device ({product:#x})")

    def firmware(self) -> str:
        """Version of the gripper's firmware: major.minor, build."""
        version, build = self._read(_FIRMWARE, 2, "its firmware")
        return f"{version >> 8}.{version & 0xFF}, build {build}"

    def state(self) -> BoxState:
        """What the box reports now."""
        values = dict(zip(_STATE, self._read(_STATE.start, len(_STATE), "its state"), strict=True))
        status = values[_STATUS]
        return BoxState(
            busy=bool(status & _BUSY),
            grip=bool(status & _GRIP),
            offset_m=_signed(values[_OFFSET]) / _PER_M,
            bare_width_m=_signed(values[_BARE_WIDTH]) / _PER_M,
            tip_width_m=_signed(values[_TIP_WIDTH]) / _PER_M,
            fault=_fault(status),
        )

    def set_offset(self, offset_m: float) -> None:
        """Say how far each mounted tip reaches inwards."""
        self._write(_SET_OFFSET, [round(offset_m * _PER_M) & 0xFFFF], "its fingertip offset")

    def grip(self, width_m: float, force_n: float) -> None:
        """Send the tips to a width. A box whose gripper is busy ignores it."""
        self._write(_COMMAND, [round(force_n * _PER_N), round(width_m * _PER_M), _GRIP_WITH_OFFSET], "a width to go to")

    def stop(self) -> None:
        """Stop the fingers where they are."""
        self._write(_CONTROL, [_STOP], "to stop")

    def power_cycle(self) -> None:
        """Switch the gripper off and on again; it does not answer meanwhile (1 to 2 s)."""
        self._write(0, [_POWER_CYCLE], "a power cycle", _BOX_UNIT)

    def _hear(self, sending: bool, data: bytes) -> bytes:
        self._heard = not sending
        # All that has come since the request and was not understood.
        if not sending and len(data) > _LONGEST_RESPONSE:
            raise ValueError(f"{len(data)} bytes")
        return data

    def _read(self, address: int, count: int, what: str) -> Sequence[int]:
        unit = self._unit
        registers = self._ask(
            lambda client: client.read_holding_registers(address, count=count, device_id=unit),
            f"asked for {what}",
            unit,
        ).registers
        if len(registers) != count:
            self._lose(f"asked for {what}, answered with {len(registers)} registers for {count}: restart the box")
        return registers

    def _write(self, address: int, values: list[int], what: str, unit: int | None = None) -> None:
        to = self._unit if unit is None else unit
        self._ask(lambda client: client.write_registers(address, values, device_id=to), f"told {what}", to)

    def _ask(self, request: Callable[[ModbusTcpClient], ModbusPDU], what: str, unit: int) -> ModbusPDU:
        """One request and its answer."""
        from pymodbus.exceptions import ConnectionException

        client = self._need_client()
        try:
            response = request(client)
        except (ConnectionException, OSError):
            self._lose(f"{what}, hung up; it serves one client at a time: close other connections, then connect again")
        except Exception as error:  # bytes that mean nothing make the library fail in many ways
            if self._heard:
                self._lose(f"{what}, answered with bytes that are no Modbus ({error}): check what is at that address")
            self._lose(
                f"{what}, gave no answer in {self._timeout_s:g} s; check its link, that unit {unit} is right "
                "(65 Quick Changer, 66 or 67 Dual Quick Changer), and that the gripper has power, then connect again"
            )
        if response.isError():
            code = response.exception_code
            raise DeviceFault(
                f"{self.place}: {what}, refused with Modbus exception {code} ({_EXCEPTIONS.get(code, 'unknown')}); "
                "check which gripper and which firmware the Compute Box has",
                device="gripper",
            )
        return response

    def _need_client(self) -> ModbusTcpClient:
        if self._client is None:
            raise ConnectionLost(f"{self.place}: {self._why_closed}", device="gripper")
        return self._client

    def _lose(self, what: str) -> NoReturn:
        self.close("the link was lost; connect again")
        raise ConnectionLost(f"{self.place}: {what}", device="gripper")


def _fault(status: int) -> str:
    """What keeps a gripper of this status from moving, and its cure; empty if nothing does."""
    tripped = [name for name, bit in _TRIPPED.items() if status & bit]
    if not tripped and not status & _SAFETY_ERROR:
        return ""
    pushed = [name for name, bit in _PUSHED.items() if status & bit]
    what = f"safety switch {' and '.join(tripped)} has tripped" if tripped else "safety error at power on"
    first = f"free switch {' and '.join(pushed)}, which is still pushed" if pushed else "see what pushed the switch"
    return f"{what}, it will not move; {first}, then power-cycle it with `robotcell recover` or at the tool changer"


def _signed(register: int) -> int:
    """Of a two's complement of 16 bits."""
    return register - 0x10000 if register & 0x8000 else register
