"""A UR controller in its own process, and an arm that does exactly what it is told."""

from __future__ import annotations

import multiprocessing
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE, PERIOD_S, Record
from sim_twin.wire.ur.controller import UNLOCK_AFTER_S
from sim_twin.wire.ur.server import serve_ur

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess
    from typing import Self

    from sim_twin.wire.faults import Fault

START_Q = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)


class ServedController:
    """Serves a controller on an address; its joints follow every target at once.

    `push` is the force (3,) [N] on arm and tool, and `held` keeps the joints where they are.
    """

    def __init__(self, host: str, unlock_after_s: float = UNLOCK_AFTER_S) -> None:
        self.host = host
        self.unlock_after_s = unlock_after_s
        self.push = np.zeros(3)
        self.held = False
        self.endpoints: dict[str, str] = {}
        self._ended = threading.Event()
        self._process: BaseProcess | None = None
        self._faults: Any = None

    def __enter__(self) -> Self:
        context = multiprocessing.get_context("spawn")
        self.command, self.state = Record(ARM_COMMAND), Record(CELL_STATE)
        far_faults, self._faults = context.Pipe(duplex=False)
        near_ready, ready = context.Pipe(duplex=False)
        self._thread = threading.Thread(target=self._follow)
        self._thread.start()
        self.process = context.Process(
            target=serve_ur,
            args=(self.host, START_Q, self.unlock_after_s, self.command.name, self.state.name, far_faults, ready),
        )
        self.process.start()
        far_faults.close()
        ready.close()
        assert near_ready.poll(30), "the controller does not start"
        self.endpoints = near_ready.recv()
        near_ready.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._faults.close()
        self.process.join(5)
        assert self.process.exitcode == 0
        self.process.close()
        self._ended.set()
        self._thread.join()
        self.command.close()
        self.state.close()

    def inject(self, *faults: Fault) -> None:
        """Have these faults, and no others."""
        self._faults.send(faults)
        time.sleep(0.05)

    @property
    def q(self) -> np.ndarray:
        """What the controller commands now."""
        return np.array(self.command.read()["q"])

    def _follow(self) -> None:
        q, qd, before = np.array(START_Q), np.zeros(6), 0
        while not self._ended.wait(0.002):
            command = self.command.read()
            now, tick = time.monotonic(), int(command["tick"])
            if tick > before and not self.held:
                qd = (command["q"] - q) / ((tick - before) * PERIOD_S)
                q = np.array(command["q"])
            before = tick
            wrench = np.concatenate([self.push, np.zeros(3)])
            self.state.write(t=now, wall=now, q=q, qd=qd, wrench=wrench, robot_force=self.push)
