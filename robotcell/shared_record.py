"""One record in memory that two processes share: one writes, the other reads, and neither ever waits.

The writer makes the record's number odd, writes, and makes it even again; a reader that met a write half done reads
once more.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mmap import mmap

    from robotcell.geometry import Array

_NUMBER_BYTES = 8
# A write takes microseconds. One that has not ended after this never will: its process died in the middle.
_WRITE_LASTS_S = 0.05


def record_size(dtype: np.dtype[Any]) -> int:
    """Bytes that a record needs."""
    return _NUMBER_BYTES + dtype.itemsize


class SharedRecord:
    """A record of a `dtype` at `offset` of a buffer; fresh memory holds zeros, which is a record of zeros."""

    def __init__(self, dtype: np.dtype[Any], buffer: mmap | memoryview, offset: int = 0) -> None:
        self._number: npt.NDArray[np.uint64] = np.ndarray((1,), np.uint64, buffer, offset)
        self._data: npt.NDArray[np.void] = np.ndarray((1,), dtype, buffer, offset + _NUMBER_BYTES)

    def write(self, **fields: float | Array) -> None:
        """Set some fields; the others keep their values."""
        self._number[0] += 1
        for key, value in fields.items():
            self._data[key][0] = value
        self._number[0] += 1

    def read(self) -> np.void:
        """A copy of the record.

        Raises:
            TimeoutError: the writer died while it wrote.
        """
        deadline = time.monotonic() + _WRITE_LASTS_S
        while True:
            before = int(self._number[0])
            if before % 2 == 0:
                copy = self._data.copy()
                if int(self._number[0]) == before:
                    return copy[0]  # type: ignore[no-any-return]
            if time.monotonic() > deadline:
                raise TimeoutError("the record's writer died while it wrote")
            time.sleep(0)
