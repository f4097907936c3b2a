"""The registers by which ur_rtde and its control script talk: arguments of a command, its answer, and its status."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_twin.wire.ur.program import checked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.interfaces import Array
    from sim_twin.wire.ur.pose import Pose
    from sim_twin.wire.ur.registers import Registers


class ControlRegisters:
    """The half of the registers that one upload of the script uses; indices count from its first one.

    Args:
        registers: of the controller.
        offset: of the half, 0 or 24.
    """

    def __init__(self, registers: Registers, offset: int) -> None:
        self._registers = registers
        self._offset = offset
        self._writes = 0
        self._operation = 0

    def integer(self, index: int) -> int:
        """One integer argument."""
        return self._registers.input_int[self._offset + index]

    def number(self, index: int) -> float:
        """One argument.

        Raises:
            ScriptError: no robot has a use for it; the same for all below.
        """
        return checked(self._registers.input_double[self._offset + index])

    def floats(self, index: int, count: int) -> list[float]:
        """Several arguments."""
        values = self._registers.input_double[self._offset + index : self._offset + index + count]
        return [checked(value) for value in values]

    def six(self, index: int) -> Array:
        """Six arguments (6,)."""
        return np.array(self.floats(index, 6))

    def pose(self, index: int) -> Pose:
        """A pose."""
        x, y, z, rx, ry, rz = self.floats(index, 6)
        return x, y, z, rx, ry, rz

    def selection(self) -> Array:
        """(6,) which axes force mode makes compliant."""
        return np.array(self._registers.input_int[self._offset + 2 : self._offset + 8], dtype=np.float64)

    def answer(self, value: int) -> None:
        """Answer with an integer."""
        self._registers.output_int[self._offset + 1] = int(value)

    def answer_floats(self, values: Sequence[float]) -> None:
        """Answer with numbers."""
        self._registers.output_double[self._offset : self._offset + len(values)] = values

    def set_status(self, status: int) -> None:
        """Say whether the script is ready for a command, or has done one."""
        self._registers.output_int[self._offset] = status

    def report_operation(self, *, running: bool, progress: int = 0) -> None:
        """Set the word of the asynchronous operation; progress 0 begins a new one."""
        self._writes = (self._writes + 1) % 128
        if running and progress == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        if running:
            word |= min(progress, 0x7FFF) | 0x8000
        self._registers.output_int[self._offset + 2] = word
