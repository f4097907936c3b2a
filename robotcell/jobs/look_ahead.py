"""Looks at the table and thinks about what it shows while the arm is still moving.

The camera is polled from the loop that supervises the motion; what takes longer than a period runs in one thread, which
touches no device.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Generic, TypeVar

from robotcell.errors import CalibrationError, CellError, ConnectionLost, DeviceFault
from robotcell.motion.grasp import LOAD_REACH_M
from robotcell.perception.view import View, see, view_blocked

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.cell import Cell
    from robotcell.config import Workspace
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import RgbdFrame

T = TypeVar("T")


class LookAhead(Generic[T]):
    """One look during a motion. A context manager: it ends when its thread has.

    Args:
        cell: connected.
        workspace: the map to build.
        think: is given the view, in the thread.
    """

    def __init__(self, cell: Cell, workspace: Workspace, think: Callable[[View], T]) -> None:
        self._cell, self._workspace, self._think = cell, workspace, think
        self._since: float | None = None
        # Since then: times on the cell's clock [s] and joint angles (6,) [rad].
        self._course: list[tuple[float, Array]] = []
        self._thoughts: Future[tuple[View, T] | None] | None = None
        self._lost: CellError | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="look-ahead")

    def __enter__(self) -> LookAhead[T]:
        return self

    def __exit__(self, *exception: object) -> None:
        self._thread.shutdown()

    def poll(self) -> None:
        """Take the next step, if one can be taken now; returns at once. Called in every supervision period.

        A camera that fails does not stop the motion: `result` tells of it.
        """
        if self._thoughts is not None or self._lost is not None:
            return
        cell = self._cell
        if self._since is None:
            if view_blocked(cell.devices, cell.config, self._workspace, LOAD_REACH_M):
                return
            self._since = cell.clock.now()
        state = cell.arm.state()
        self._course.append((state.t, state.q))
        try:
            develop = cell.camera.poll(self._since)
        except (ConnectionLost, DeviceFault) as error:
            self._lost = error
            return
        if develop is not None:
            self._thoughts = self._thread.submit(self._see, develop)

    def result(self) -> tuple[View, T] | None:
        """The view, and what came of it; None where no frame of use was taken. Waits for the thread.

        An arm that still moves may hide what it would not hide at home: a frame of no use says nothing of the cell.

        Raises:
            ConnectionLost, DeviceFault: the camera delivers nothing, or stale frames.
        """
        if self._lost is not None:
            raise self._lost
        return None if self._thoughts is None else self._thoughts.result()

    def _see(self, develop: Callable[[], RgbdFrame]) -> tuple[View, T] | None:
        frame = develop()
        q = min(self._course, key=lambda entry: abs(entry[0] - frame.t))[1]
        try:
            view = see(frame, self._cell.config, q, self._workspace)
        except (CalibrationError, DeviceFault):
            return None
        return view, self._think(view)
