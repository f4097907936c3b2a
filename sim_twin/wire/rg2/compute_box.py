"""The OnRobot Compute Box with an RG2: its register map over Modbus TCP, in a process of its own.

After OnRobot's "Connectivity Guide for Modbus RTU and TCP", as public drivers quote and use it. What the guide leaves
open, and was decided here, is listed in docs/reference/served-gripper.md.
"""

from __future__ import annotations

import asyncio
import signal
import struct
import time
from typing import TYPE_CHECKING

from robotcell.geometry import rg2
from sim_twin.wire.faults import FaultInbox, Kind
from sim_twin.wire.rg2.modbus import ModbusServer, Refusal, RefusedError
from sim_twin.wire.shared_state import CELL_STATE, GRIPPER_COMMAND, Record

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from multiprocessing.connection import Connection

GRIPPER_FAULTS: frozenset[tuple[str, Kind, str]] = frozenset(
    [
        ("modbus", Kind.OFF, ""),
        ("modbus", Kind.STUCK, ""),
        ("modbus", Kind.GARBAGE, ""),
        ("modbus", Kind.WRONG, "unit"),
        ("modbus", Kind.WRONG, "exception"),
        ("modbus", Kind.DELAYED, ""),
        ("modbus", Kind.INTERMITTENT, ""),
        ("state", Kind.STUCK, ""),
        *(("state", Kind.WRONG, what) for what in ("busy", "grip", "no_grip", "s1", "s2", "safety_error", "offset")),
    ]
)

# Behind a Quick Changer; the Compute Box's own.
_TOOL, _BOX = 65, 63
_FORCE, _WIDTH, _CONTROL, _OFFSET, _DEPTH, _RELATIVE_DEPTH = 0, 1, 2, 258, 263, 264
_BARE_WIDTH, _STATUS, _TIP_WIDTH, _SET_OFFSET, _PRODUCT, _FIRMWARE, _SERIAL = 267, 268, 275, 1031, 1536, 1540, 1545
# Public drivers read the state in one piece: the registers in between are there, and 0.
_STATE = range(_OFFSET, _TIP_WIDTH + 1)
_GRIP, _STOP, _GRIP_WITH_OFFSET = 1, 8, 16
_HIGHEST = {_FORCE: 400, _WIDTH: 1100}
_POWER_CYCLE = 2
# "1-2 s".
_POWER_CYCLE_S = 1.5
_WRONG_UNIT = 66
# Of faults that need a time and got none.
_USUAL_S = 1.0
_BUSY, _GRIP_DETECTED, _SAFETY_ERROR = 1 << 0, 1 << 1, 1 << 6
# Of each safety switch: pushed, and its circuit tripped.
_SWITCHES = {"s1": (1 << 2, 1 << 3), "s2": (1 << 4, 1 << 5)}
_IDENTITY = {
    _PRODUCT: 0x20,
    _FIRMWARE: 1 << 8 | 0,
    _FIRMWARE + 1: 1,
    **dict(enumerate(struct.unpack(">16H", b"TWIN-RG2-0001".ljust(32, b"\0")), _SERIAL)),
}


def serve_compute_box(
    host: str, port: int, gripper_command: str, cell_state: str, faults: Connection, ready: Connection
) -> None:
    """Serve until SIGTERM, or until the supervisor is gone.

    Args:
        host: address on which it listens.
        port: there; 0 for any.
        gripper_command: name of the record of commands.
        cell_state: name of the record of the world.
        faults: lists of `Fault`.
        ready: gets {"modbus": "host:port"}, or {"error": text}.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    command, state = Record(GRIPPER_COMMAND, gripper_command), Record(CELL_STATE, cell_state)
    try:
        asyncio.run(_serve(Rg2(command, state), host, port, faults, ready))
    finally:
        command.close()
        state.close()


class Rg2:
    """The units behind the box: the gripper at 65, the box itself at 63.

    Args:
        command: the record `GRIPPER_COMMAND`.
        state: the record `CELL_STATE`.
        now: the time [s] by which a power cycle takes its time.
    """

    def __init__(self, command: Record, state: Record, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._command = command
        self._state = state
        self._targets = {_FORCE: 0, _WIDTH: 0}
        self._offset = 0
        self._count = 0
        # Whether the last command was a stop: whatever the world still reports, no grip is under way then.
        self._stopped = True
        # The depth when the last motion began; None before the first.
        self._start_depth: int | None = None
        self._no_power_until = 0.0
        # Switches that are pushed, circuits that they tripped, and whether one was pushed at power on.
        self._pushed: set[str] = set()
        self._tripped: set[str] = set()
        self._safety_error = False
        self._wrong: dict[str, float | None] = {}
        self._frozen_width: int | None = None
        self._unit = _TOOL

    def take_faults(self, inbox: FaultInbox) -> None:
        """Have the faults that there are now."""
        self._unit = _WRONG_UNIT if inbox.find("modbus", Kind.WRONG, "unit") else _TOOL
        self._wrong = {
            what: fault.value
            for channel, kind, what in GRIPPER_FAULTS
            if channel == "state" and (fault := inbox.find(channel, kind, what)) and kind is Kind.WRONG
        }
        frozen = inbox.find("state", Kind.STUCK)
        self._frozen_width = (self._width() if self._frozen_width is None else self._frozen_width) if frozen else None
        self._pushed = {switch for switch in _SWITCHES if switch in self._wrong}
        if self._pushed - self._tripped:
            self._tripped |= self._pushed
            self._send(stop=True)
        self._safety_error |= "safety_error" in self._wrong

    def answers(self, unit: int) -> bool:
        """The box always, the gripper while it has power."""
        return unit == _BOX or (unit == self._unit and self._powered())

    def read(self, unit: int, address: int, count: int) -> list[int]:
        """Registers of a unit; see `Units`."""
        wanted = range(address, address + count)
        registers = {_FORCE: 0} if unit == _BOX else {**dict.fromkeys(_STATE, 0), **self._measure(), **_IDENTITY}
        if not all(register in registers for register in wanted):
            raise RefusedError(Refusal.ADDRESS)
        return [registers[register] & 0xFFFF for register in wanted]

    def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Set registers of a unit; see `Units`."""
        writes = dict(enumerate(values, address))
        if unit == _BOX:
            self._write_box(writes)
            return
        if not all(register in (_FORCE, _WIDTH, _CONTROL, _SET_OFFSET) for register in writes):
            raise RefusedError(Refusal.ADDRESS)
        if any(writes.get(register, 0) > highest for register, highest in _HIGHEST.items()):
            raise RefusedError(Refusal.VALUE)
        control = writes.get(_CONTROL)
        if control not in (None, _GRIP, _STOP, _GRIP_WITH_OFFSET):
            raise RefusedError(Refusal.VALUE)
        self._targets.update({register: writes[register] for register in self._targets if register in writes})
        if _SET_OFFSET in writes:
            (self._offset,) = struct.unpack(">h", struct.pack(">H", writes[_SET_OFFSET]))
        if control == _STOP:
            self._send(stop=True)
        elif control is not None:
            self._grip(with_offset=control == _GRIP_WITH_OFFSET)

    def _write_box(self, writes: dict[int, int]) -> None:
        if list(writes) != [0]:
            raise RefusedError(Refusal.ADDRESS)
        if writes[0] != _POWER_CYCLE:
            raise RefusedError(Refusal.VALUE)
        self._send(stop=True)
        self._no_power_until = self._now() + _POWER_CYCLE_S
        # A switch that is pushed while the power comes back shows as a safety error, and trips again.
        self._safety_error = bool(self._pushed)
        self._tripped = set(self._pushed)

    def _grip(self, *, with_offset: bool) -> None:
        """Start a motion, unless the gripper is moving or must not move."""
        if self._tripped or self._safety_error or "busy" in self._wrong:
            return
        if not self._stopped and self._measure()[_STATUS] & _BUSY:
            return
        width = self._targets[_WIDTH] + (2 * self._offset if with_offset else 0)
        self._start_depth = self._measure()[_DEPTH]
        self._send(
            width_m=min(max(width / 10_000, rg2.MIN_WIDTH_M), rg2.MAX_WIDTH_M),
            force_n=max(self._targets[_FORCE] / 10, rg2.MIN_FORCE_N),
        )

    def _send(self, *, stop: bool = False, width_m: float = 0.0, force_n: float = 0.0) -> None:
        self._count += 1
        self._stopped = stop
        self._command.write(count=self._count, stop=stop, width_m=width_m, force_n=force_n)

    def _powered(self) -> bool:
        return self._now() >= self._no_power_until

    def _width(self) -> int:
        """Between the bare fingers [0.1 mm]."""
        return round(10_000 * float(self._state.read()["width_m"]))

    def _measure(self) -> dict[int, int]:
        """The registers that change by themselves, signed."""
        width = self._width() if self._frozen_width is None else self._frozen_width
        width_m = min(max(width / 10_000, rg2.MIN_WIDTH_M), rg2.MAX_WIDTH_M)
        depth = round(10_000 * rg2.tip_retraction(width_m))
        offset = self._offset
        if "offset" in self._wrong:
            offset += round(10_000 * (self._wrong["offset"] or 0.005))
        return {
            _OFFSET: offset,
            _DEPTH: depth,
            _RELATIVE_DEPTH: 0 if self._start_depth is None else depth - self._start_depth,
            _BARE_WIDTH: width,
            _STATUS: self._status(),
            _TIP_WIDTH: width - 2 * offset,
        }

    def _status(self) -> int:
        state = self._state.read()
        # A command that the world has not seen yet is under way.
        busy = state["busy"] or state["gripper_count"] != self._count or "busy" in self._wrong
        grip = (state["grip_detected"] or "grip" in self._wrong) and "no_grip" not in self._wrong
        status = _BUSY * bool(busy) | _GRIP_DETECTED * bool(grip) | _SAFETY_ERROR * self._safety_error
        for switch, (pushed, tripped) in _SWITCHES.items():
            status |= pushed * (switch in self._pushed) | tripped * (switch in self._tripped)
        return status


async def _serve(device: Rg2, host: str, port: int, faults: Connection, ready: Connection) -> None:
    """Serve, with the faults that come, until the end."""
    loop = asyncio.get_running_loop()
    server, inbox = ModbusServer(device, host, port), FaultInbox(faults, "gripper")
    ended, changed = asyncio.Event(), asyncio.Event()

    def take_faults() -> None:
        try:
            inbox.poll()
        except EOFError:
            loop.remove_reader(faults.fileno())
            ended.set()
            return
        device.take_faults(inbox)
        server.silent = inbox.find("modbus", Kind.STUCK) is not None
        server.garbled = inbox.find("modbus", Kind.GARBAGE) is not None
        refusal, delay = inbox.find("modbus", Kind.WRONG, "exception"), inbox.find("modbus", Kind.DELAYED)
        server.refuses = None if refusal is None else min(max(int(refusal.value or Refusal.FAILURE), 1), 255)
        server.delay_s = 0.0 if delay is None else delay.value or _USUAL_S
        changed.set()

    loop.add_signal_handler(signal.SIGTERM, ended.set)
    try:
        await server.open()
    except OSError as error:
        ready.send({"error": f"the Compute Box cannot listen at {host}:{port} ({error.strerror}): take another port"})
        return
    ready.send({"modbus": f"{host}:{server.port}"})
    loop.add_reader(faults.fileno(), take_faults)
    link = asyncio.create_task(_keep_link(server, inbox, changed))
    ending = asyncio.create_task(ended.wait())
    await asyncio.wait([link, ending], return_when=asyncio.FIRST_COMPLETED)
    await server.close()
    for task in (link, ending):
        task.cancel()
    # What ended the link by itself is to be seen.
    await asyncio.gather(*[task for task in (link, ending) if task.done()])


async def _keep_link(server: ModbusServer, inbox: FaultInbox, changed: asyncio.Event) -> None:
    """Have the server listen, or not, as the faults want it."""
    there = True
    while True:
        blinking = inbox.find("modbus", Kind.INTERMITTENT)
        there = not inbox.find("modbus", Kind.OFF) and not (blinking and there)
        await (server.open() if there else server.close())
        try:
            await asyncio.wait_for(changed.wait(), (blinking.value or _USUAL_S) if blinking else None)
        except asyncio.TimeoutError:
            continue
        changed.clear()
