"""One record in memory that two processes share: one writes, any number read, and nobody ever waits for anybody.

There are two slots. The writer fills the one that is not current and then makes it current, so that a writer that was
suspended or killed in the middle leaves the last whole record.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mmap import mmap

    from robotcell.interfaces import Array

_NUMBER_BYTES = 8


def record_size(dtype: np.dtype[Any]) -> int:
    """Bytes that a record needs; a multiple of 8."""
    return (_NUMBER_BYTES + 2 * dtype.itemsize + 7) // 8 * 8


class SharedRecord:
    """A record of a `dtype` at `offset` of a buffer; fresh memory holds zeros, which is a record of zeros."""

    def __init__(self, dtype: np.dtype[Any], buffer: mmap | memoryview, offset: int = 0) -> None:
        # How often it was written; the slot of that number modulo 2 is current.
        self._number: npt.NDArray[np.uint64] = np.ndarray((1,), np.uint64, buffer, offset)
        self._slots: npt.NDArray[np.void] = np.ndarray((2,), dtype, buffer, offset + _NUMBER_BYTES)

    @property
    def written(self) -> bool:
        """Whether anything was ever written."""
        return bool(self._number[0] > 0)

    def write(self, **fields: float | Array) -> None:
        """Set some fields; the others keep their values."""
        number = int(self._number[0])
        slot = self._slots[(number + 1) % 2 : (number + 1) % 2 + 1]
        slot[0] = self._slots[number % 2]
        for key, value in fields.items():
            slot[key][0] = value
        self._number[0] = number + 1

    def read(self) -> np.void:
        """A copy of the newest record."""
        while True:
            number = int(self._number[0])
            copy = self._slots[number % 2 : number % 2 + 1].copy()
            if int(self._number[0]) == number:
                return copy[0]  # type: ignore[no-any-return]
