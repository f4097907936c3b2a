"""What the processes of a served cell tell each other, in shared memory: nobody ever waits for anybody.

Each record has one writer and any number of readers.
"""

from __future__ import annotations

from multiprocessing.shared_memory import SharedMemory
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.io.shared_record import SharedRecord, record_size

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

# The control period of the UR controller [s]: 500 Hz (Universal Robots, e-Series).
PERIOD_S = 0.002

# Written by the UR controller once per control period, read by the world. `powered`: the joints follow `q`; else the
# brakes hold them.
# `T_flange_tcp` is what the program set, `payload_kg` too; the world only reports by them.
ARM_COMMAND = np.dtype(
    [("tick", "u8"), ("powered", "u1"), ("q", "f8", 6), ("T_flange_tcp", "f8", (4, 4)), ("payload_kg", "f8")]
)
# Written by the Compute Box, read by the world: the width between the bare fingers, as in `CELL_STATE`. A command is
# new when `count` has grown.
GRIPPER_COMMAND = np.dtype([("count", "u8"), ("stop", "u1"), ("width_m", "f8"), ("force_n", "f8")])
# Written by the world once per physics step. `t` is simulated time [s], `wall` time.monotonic() [s] of the step.
# `wrench`: (6,) [N, N m] that the surroundings exert on the gripper, base axes, about the origin of the flange.
# `robot_force`: (3,) [N] on arm and gripper together. `gripper_count`: of the last gripper command that was taken up.
# `skipped`: steps that were left out so far, because the physics could not keep up with the clock.
CELL_STATE = np.dtype(
    [
        ("t", "f8"),
        ("wall", "f8"),
        ("q", "f8", 6),
        ("qd", "f8", 6),
        ("wrench", "f8", 6),
        ("robot_force", "f8", 3),
        ("width_m", "f8"),
        ("busy", "u1"),
        ("grip_detected", "u1"),
        ("gripper_count", "u8"),
        ("skipped", "u8"),
    ]
)


def poses_dtype(count: int) -> np.dtype[np.void]:
    """The record that the world writes for the camera: the time and T_base_visual of all its visuals."""
    return np.dtype([("t", "f8"), ("poses", "f8", (count, 4, 4))])


class Record:
    """One record in shared memory.

    Args:
        dtype: its fields.
        name: of a block that exists, to attach to it; None makes one.
    """

    def __init__(self, dtype: np.dtype[Any], name: str | None = None) -> None:
        self._memory = SharedMemory(name=name, create=name is None, size=record_size(dtype))
        self._owner = name is None
        self._record: SharedRecord | None = SharedRecord(dtype, self._memory.buf)  # type: ignore[arg-type]

    @property
    def name(self) -> str:
        """By which another process attaches."""
        return self._memory.name

    @property
    def written(self) -> bool:
        """Whether anything was ever written."""
        return self._open().written

    def write(self, **fields: float | Array) -> None:
        """Set some fields; the others keep their values."""
        self._open().write(**fields)

    def read(self) -> np.void:
        """A copy of the record."""
        return self._open().read()

    def close(self) -> None:
        """Let the memory go; its maker removes it. Idempotent."""
        # The record holds on to the buffer.
        self._record = None
        self._memory.close()
        if self._owner:
            self._owner = False
            self._memory.unlink()

    def _open(self) -> SharedRecord:
        if self._record is None:
            raise ValueError(f"the record {self._memory.name} is closed")
        return self._record
