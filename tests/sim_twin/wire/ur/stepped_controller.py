"""A controller without sockets, whose joints follow at once, ticked by hand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_twin.wire.shared_state import CELL_STATE, PERIOD_S
from sim_twin.wire.ur.control_loop import DONE, READY, ControlLoop
from sim_twin.wire.ur.controller import Controller
from sim_twin.wire.ur.modes import RuntimeState
from sim_twin.wire.ur.script_reader import ScriptReader
from tests.sim_twin.wire.ur.stub_world import START_Q

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.geometry.transforms import Array
    from sim_twin.wire.ur.moves import Move
    from sim_twin.wire.ur.ports import Session
    from sim_twin.wire.ur.script_reader import Received


def answers(session: Session, data: bytes) -> bytes:
    """What a session answers to these bytes."""
    session.feed(data)
    return b"".join(iter(session.step, None))


def received(data: bytes, reader: ScriptReader | None = None) -> list[Received]:
    """What is complete with these bytes, and what is refused."""
    reader = reader or ScriptReader()
    reader.feed(data)
    found = []
    while reader.waiting:
        one = reader.read_line()
        if one is not None:
            found.append(one)
    return found


class SteppedController:
    """Ticks a controller; `push` (6,) is the wrench on the tool, and `held` keeps the joints where they are."""

    def __init__(self) -> None:
        self.controller = Controller(np.array(START_Q))
        self.q = np.array(START_Q)
        self.push = np.zeros(6)
        self.held = False
        self.now = 100.0

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            cells = np.zeros(1, CELL_STATE)
            cells["q"], cells["wall"] = self.q, self.now
            cells["wrench"], cells["robot_force"] = self.push, self.push[:3]
            self.controller.tick(self.now, cells[0])
            self.now += PERIOD_S
            if not self.held:
                self.q = self.controller.arm.q.copy()

    def seconds(self, time: float) -> None:
        self.tick(round(time / PERIOD_S))

    def rest(self, limit: float = 20.0) -> None:
        """Until the arm stands still."""
        self.tick(2)
        for _ in range(round(limit / PERIOD_S)):
            if self.controller.arm.steady:
                return
            self.tick()
        raise AssertionError("the arm does not come to rest")

    def notes(self) -> str:
        return "\n".join(str(report) for report in self.controller.reports)


class SteppedControlLoop(SteppedController):
    """A stepped whose controller runs ur_rtde's control loop."""

    def __init__(self, path: Sequence[Move] = (), offset: int = 0) -> None:
        super().__init__()
        self.offset = offset
        self.loop = ControlLoop(self.controller, offset, path)
        assert self.controller.start(self.loop.program)
        self.tick()
        assert self.status == READY

    @property
    def status(self) -> int:
        return self.controller.registers.output_int[self.offset]

    @property
    def running(self) -> bool:
        return self.controller.runtime is RuntimeState.PLAYING

    def set(self, command: int, doubles: Sequence[float] | Array = (), ints: Sequence[int] = ()) -> None:
        """Put a command and its arguments into the registers."""
        registers, offset = self.controller.registers, self.offset
        registers.input_double[offset : offset + len(doubles)] = [float(value) for value in doubles]
        registers.input_int[offset + 1 : offset + 1 + len(ints)] = ints
        registers.input_int[offset] = command

    def call(
        self, command: int, doubles: Sequence[float] | Array = (), ints: Sequence[int] = (), limit: float = 20
    ) -> bool:
        """A command from its registers to the loop's being ready again; whether the program still runs."""
        self.set(command, doubles, ints)
        for _ in range(round(limit / PERIOD_S)):
            self.tick()
            if not self.running:
                return False
            if self.status == DONE:
                break
        else:
            raise AssertionError(f"command {command} does not end")
        self.set(0)
        self.tick()
        assert self.status == READY
        return True

    def answer(self, command: int, doubles: Sequence[float] | Array = (), count: int = 6) -> list[float]:
        """The numbers that a command answers with."""
        assert self.call(command, doubles)
        return self.controller.registers.output_double[self.offset : self.offset + count]

    def flag(self, command: int, doubles: Sequence[float] | Array = ()) -> int:
        """The integer that a command answers with."""
        assert self.call(command, doubles)
        return self.controller.registers.output_int[self.offset + 1]

    def word(self) -> tuple[int, bool, int]:
        """The asynchronous operation: number, running, progress."""
        word = self.controller.registers.output_int[self.offset + 2]
        return word >> 24 & 0x7F, bool(word & 0x8000), word & 0x7FFF
