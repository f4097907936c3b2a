"""A whole cell that is served: starts its processes, hands them their faults, and ends them."""

from __future__ import annotations

import contextlib
import ipaddress
import multiprocessing
import os
import signal
import socket
import sys
import threading
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.shared_memory import SharedMemory
from typing import TYPE_CHECKING, Any

from robotcell.errors import ConfigError, ConnectionLost
from sim_twin.wire.control import Control
from sim_twin.wire.d415 import server as camera_server
from sim_twin.wire.faults import Device, Fault, Kind
from sim_twin.wire.rg2 import compute_box as box
from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE, GRIPPER_COMMAND, Record
from sim_twin.wire.ur import server as ur
from sim_twin.wire.world_process import serve_world

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess
    from types import TracebackType

    import numpy as np
    from typing_extensions import Self

    from robotcell.config import CellConfig

# Ten objects are built in half a second; a busy machine may need many times that to import everything.
_START_S = 90.0
_END_S = 5.0
# The controller keeps a period of 2 ms: it goes ahead of everything else on the computer, where the system allows it.
_REALTIME = ("ur",)
FAULTS: dict[Device, frozenset[tuple[str, Kind, str]]] = {
    "arm": ur.FAULTS,
    "gripper": box.FAULTS,
    "camera": camera_server.FAULTS,
}
_TIMED = (Kind.SLOW, Kind.DELAYED, Kind.INTERMITTENT)


@dataclass
class _Server:
    """One process and the supervisor's ends of its two pipes."""

    process: SpawnProcess
    faults: Connection
    ready: Connection


class ServedCell:
    """The devices of a simulated cell, served over their wire protocols by processes of its own.

    Args:
        config: the cell; its backend must be the twin.
        host: address on which everything listens.
        modbus_port: of the Compute Box.
        camera_port: of the frames.
        control_port: of the control socket for faults; None for none.
    """

    def __init__(
        self,
        config: CellConfig,
        host: str = "127.0.0.2",
        modbus_port: int = 1502,
        camera_port: int = 30415,
        control_port: int | None = None,
    ) -> None:
        self._config = config
        self._host = host
        self._modbus_port = modbus_port
        self._camera_port = camera_port
        self._control_port = control_port
        self._servers: dict[str, _Server] = {}
        self._records: list[Record] = []
        self._poses: str | None = None
        self._faults: list[Fault] = []
        self._lock = threading.Lock()
        self._control: Control | None = None
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
        return {name: server.process.pid or -1 for name, server in self._servers.items()}

    @property
    def ended(self) -> list[str]:
        """Names of processes that are there no longer."""
        return [name for name, server in self._servers.items() if not server.process.is_alive()]

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that the cell has now."""
        return tuple(self._faults)

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
        self._launch("world", serve_world, config, arm.name, gripper.name, state.name)
        self._launch("ur", ur.serve_ur, host, config.motion.home_q, arm.name, state.name)
        self._launch("box", box.serve_box, host, self._modbus_port, gripper.name, state.name)
        # The quick ones first: a port that is taken is said before the world is built.
        for name in ("ur", "box"):
            self.endpoints.update(self._wait_for(name))
        world = self._wait_for("world")
        self._poses = world["poses"]
        camera = (host, self._camera_port, config, world["visuals"], self._poses)
        self._launch("camera", camera_server.serve_camera, *camera)
        self.endpoints.update(self._wait_for("camera"))
        if self._control_port is not None:
            self._control = Control(self, host if is_loopback(host) else "127.0.0.1", self._control_port)
            self.endpoints["control"] = self._control.endpoint

    def close(self) -> None:
        """End everything. Idempotent."""
        if self._control is not None:
            self._control.close()
            self._control = None
        for server in self._servers.values():
            server.process.terminate()
        for server in self._servers.values():
            server.process.join(_END_S)
            if server.process.is_alive():
                server.process.kill()
                server.process.join()
            server.process.close()
            server.faults.close()
            server.ready.close()
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

    def _launch(self, name: str, entry: Callable[..., None], *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        faults, faults_out = context.Pipe(duplex=False)
        ready_in, ready = context.Pipe(duplex=False)
        # A daemon: a supervisor that ends without closing the cell does not wait for it.
        process = context.Process(
            target=entry, args=(*arguments, faults, ready), name=f"robotcell twin {name}", daemon=True
        )
        # An interrupt at the terminal reaches the whole group; it is for the supervisor alone, from the first moment.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if name in _REALTIME and process.pid is not None and sys.platform == "linux":
            with contextlib.suppress(OSError):
                os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(10))
        # The child's ends are the child's alone, so that each side sees when the other is gone.
        faults.close()
        ready.close()
        self._servers[name] = _Server(process, faults_out, ready_in)

    def _wait_for(self, name: str) -> dict[str, Any]:
        """What a process says once it is ready."""
        server = self._servers[name]
        if not wait([server.ready, server.process.sentinel], _START_S):
            raise ConnectionLost(f"the twin's process {name!r} was not ready after {_START_S:.0f} s")
        try:
            answer: dict[str, Any] = server.ready.recv()
        except EOFError:
            server.process.join(_END_S)
            raise ConnectionLost(
                f"the twin's process {name!r} died at its start (exit code {server.process.exitcode})"
            ) from None
        if "error" in answer:
            raise ConfigError(f"the cell cannot be served: {answer['error']}")
        return answer

    def _send_faults(self) -> None:
        for server in self._servers.values():
            # One that has died needs no faults.
            with contextlib.suppress(OSError):
                server.faults.send(tuple(self._faults))


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address or a name."""
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except OSError:
        return False


def _same(a: Fault, b: Fault) -> bool:
    return (a.device, a.channel, a.kind, a.what) == (b.device, b.channel, b.kind, b.what)
