"""A whole cell that is served: starts its processes, hands them their faults, and ends them."""

from __future__ import annotations

import contextlib
import threading
from multiprocessing.shared_memory import SharedMemory
from typing import TYPE_CHECKING

from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.wire.d415.server import CAMERA_FAULTS, serve_camera
from sim_twin.wire.faults import Device, Fault, Kind
from sim_twin.wire.rg2.compute_box import GRIPPER_FAULTS, serve_compute_box
from sim_twin.wire.server_process import ServerProcess
from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE, GRIPPER_COMMAND, Record
from sim_twin.wire.ur.controller import UNLOCK_AFTER_S
from sim_twin.wire.ur.server import ARM_FAULTS, serve_ur
from sim_twin.wire.world_process import serve_world

if TYPE_CHECKING:
    from types import TracebackType

    import numpy as np
    from typing_extensions import Self

    from robotcell.config import CellConfig

FAULTS: dict[Device, frozenset[tuple[str, Kind, str]]] = {
    "arm": ARM_FAULTS,
    "gripper": GRIPPER_FAULTS,
    "camera": CAMERA_FAULTS,
}
_TIMED = (Kind.SLOW, Kind.DELAYED, Kind.INTERMITTENT)


class ServedCell:
    """The devices of a simulated cell, served over their wire protocols by processes of its own.

    Args:
        config: the cell; its backend must be the twin.
        host: address on which everything listens.
        modbus_port: of the Compute Box.
        camera_port: of the frames.
        unlock_after_s: how long after a protective stop the arm can be recovered.
    """

    def __init__(
        self,
        config: CellConfig,
        host: str = "127.0.0.2",
        modbus_port: int = 1502,
        camera_port: int = 30415,
        unlock_after_s: float = UNLOCK_AFTER_S,
    ) -> None:
        self._config = config
        self._host = host
        self._modbus_port = modbus_port
        self._camera_port = camera_port
        self._unlock_after_s = unlock_after_s
        self._servers: dict[str, ServerProcess] = {}
        self._records: list[Record] = []
        self._poses: str | None = None
        self._faults: list[Fault] = []
        self._lock = threading.Lock()
        self.endpoints: dict[str, str] = {}

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def processes(self) -> dict[str, int]:
        """Process ids by name."""
        return {name: server.pid for name, server in self._servers.items()}

    @property
    def ended(self) -> list[str]:
        """Names of processes that are there no longer."""
        return [name for name, server in self._servers.items() if not server.alive]

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that the cell has now."""
        return tuple(self._faults)

    @property
    def shared_memory(self) -> list[str]:
        """Names of the blocks of shared memory by which its processes talk."""
        names = [record.name for record in self._records]
        return names if self._poses is None else [*names, self._poses]

    def start(self) -> None:
        """Start everything and wait until it is there.

        Raises:
            ConfigError: the scene cannot be built, or a port cannot be had.
            ConnectionLost: a process died, or did not get ready.
        """
        if self._config.backend.name != "twin":
            raise ConfigError(f"only a twin can be served; the cell's backend is {self._config.backend.name!r}")
        if self._servers:
            return
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        arm, gripper, state = self._records = [Record(ARM_COMMAND), Record(GRIPPER_COMMAND), Record(CELL_STATE)]
        config, host = self._config, self._host
        servers = self._servers
        servers["world"] = ServerProcess("world", serve_world, config, arm.name, gripper.name, state.name)
        # The controller keeps a period of 2 ms.
        controller = (host, config.motion.home_q, self._unlock_after_s, arm.name, state.name)
        servers["ur"] = ServerProcess("ur", serve_ur, *controller, realtime=True)
        compute_box = (host, self._modbus_port, gripper.name, state.name)
        servers["compute box"] = ServerProcess("compute box", serve_compute_box, *compute_box)
        # The quick ones first: a port that is taken is said before the world is built.
        for name in ("ur", "compute box"):
            self.endpoints.update(servers[name].wait_until_ready())
        world = servers["world"].wait_until_ready()
        self._poses = world["poses"]
        camera = (host, self._camera_port, config, world["visuals"], self._poses)
        servers["camera"] = ServerProcess("camera", serve_camera, *camera)
        self.endpoints.update(servers["camera"].wait_until_ready())

    def close(self) -> None:
        """End everything. Idempotent."""
        for server in self._servers.values():
            server.terminate()
        for server in self._servers.values():
            server.close()
        self._servers.clear()
        self.endpoints.clear()
        self._faults.clear()
        for record in self._records:
            record.close()
        self._records.clear()
        if self._poses is not None:
            # A world that was killed has left it behind.
            with contextlib.suppress(FileNotFoundError):
                left = SharedMemory(self._poses)
                left.close()
                left.unlink()
            self._poses = None

    def state(self) -> np.void:
        """What the world says now: the record `CELL_STATE`.

        Raises:
            ConnectionLost: nothing is served.
        """
        return self._read(2)

    def command(self) -> np.void:
        """What the UR controller commands now: the record `ARM_COMMAND`.

        Raises:
            ConnectionLost: nothing is served.
        """
        return self._read(0)

    def inject(self, fault: Fault) -> None:
        """Have a fault from now on; one of the same place and kind is replaced.

        Raises:
            ConfigError: there is no such fault (the message lists those of the device), or its value makes no sense.
        """
        name = f"{fault.channel} {fault.kind.value} {fault.what}".strip()
        if name not in self.known_faults()[fault.device]:
            listed = "; ".join(self.known_faults()[fault.device])
            raise ConfigError(f"no fault of the {fault.device} is called {name!r}; there are: {listed}")
        if fault.kind in _TIMED and fault.value is not None and fault.value <= 0:
            raise ConfigError(f"the value of {name!r} must be above 0, not {fault.value:g}")
        with self._lock:
            self._faults = [known for known in self._faults if not _same(known, fault)] + [fault]
            self._send_faults()

    def clear(self) -> None:
        """Have no faults."""
        with self._lock:
            self._faults = []
            self._send_faults()

    def known_faults(self) -> dict[str, list[str]]:
        """The faults that exist, by device: channel, kind and what."""
        return {
            device: sorted(f"{channel} {kind.value} {what}".strip() for channel, kind, what in exist)
            for device, exist in FAULTS.items()
        }

    def _read(self, record: int) -> np.void:
        if not self._records:
            raise ConnectionLost("the cell is not served: start it first")
        return self._records[record].read()

    def _send_faults(self) -> None:
        for server in self._servers.values():
            server.send_faults(tuple(self._faults))


def _same(a: Fault, b: Fault) -> bool:
    return (a.device, a.channel, a.kind, a.what) == (b.device, b.channel, b.kind, b.what)
