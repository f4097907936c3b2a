"""Faults that a served cell can be given while it runs: what each one is called, and how it reaches its server.

Words as in PX4's failure injection: off, stuck, garbage, wrong, slow, delayed, intermittent.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Literal

from pydantic.dataclasses import dataclass

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

Device = Literal["arm", "gripper", "camera"]


class Kind(enum.Enum):
    """What kind of fault."""

    OFF = "off"  # not there: the port is closed, the stream ends
    STUCK = "stuck"  # there, but nothing moves on: silence, a frozen value or frame
    GARBAGE = "garbage"  # bytes or values that mean nothing
    WRONG = "wrong"  # well formed, and not what it should be; `what` says which
    SLOW = "slow"  # at a lower rate or speed, `value` says which part of the usual one
    DELAYED = "delayed"  # `value` seconds late
    INTERMITTENT = "intermittent"  # gone and back every `value` seconds


@dataclass(frozen=True, config={"extra": "forbid", "allow_inf_nan": False})
class Fault:
    """One fault. Words and types are checked.

    Attributes:
        device: that has it.
        channel: of the device, such as "rtde", "dashboard", "state" of the arm.
        kind: of fault.
        what: which of several, where a channel can be wrong in more than one way; "" where there is one.
        value: a number that the kind or `what` needs.
    """

    device: Device
    channel: str
    kind: Kind
    what: str = ""
    value: float | None = None


class FaultInbox:
    """Where a server finds the faults that it has just now.

    Args:
        connection: over which the supervisor sends the whole list of faults whenever it changes.
        device: whose faults are kept.
    """

    def __init__(self, connection: Connection, device: Device) -> None:
        self._connection = connection
        self._device = device
        self._active: tuple[Fault, ...] = ()

    def poll(self) -> bool:
        """Take in what was sent; whether anything changed. Never waits.

        Raises:
            EOFError: the supervisor is gone.
        """
        changed = False
        while self._connection.poll():
            faults: tuple[Fault, ...] = self._connection.recv()
            self._active = tuple(fault for fault in faults if fault.device == self._device)
            changed = True
        return changed

    def find(self, channel: str, kind: Kind, what: str = "") -> Fault | None:
        """The fault of this kind on a channel, None if there is none."""
        for fault in self._active:
            if (fault.channel, fault.kind, fault.what) == (channel, kind, what):
                return fault
        return None
