"""The process of the served cell that is its camera: 30 frames a second, over TCP, to whoever asks.

A frame shows the world at the moment its turn comes. The number of a frame is the number of its turn, so a frame that
could not be made in time leaves a gap, as one that a device dropped does. Nothing is rendered while nobody looks.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import time
from collections import deque
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

from robotcell.errors import CellError, ConfigError
from sim_twin.d415.open3d_core import load_open3d
from sim_twin.d415.renderer import FRAMES_PER_S, MODES, SERIAL, Renderer, reported_intrinsics
from sim_twin.options import TwinOptions
from sim_twin.wire.d415.clients import Client
from sim_twin.wire.d415.images import IMAGE_FAULTS, ImageMaker
from sim_twin.wire.d415.stream import Description, describe, encode
from sim_twin.wire.faults import FaultInbox, Kind
from sim_twin.wire.shared_state import Record, poses_dtype

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from robotcell.config import CellConfig
    from sim_twin.visual import Visual

WRONG_SERIAL = "999999999999"

CAMERA_FAULTS: frozenset[tuple[str, Kind, str]] = IMAGE_FAULTS | {
    ("stream", Kind.OFF, ""),  # the port is closed
    ("stream", Kind.STUCK, ""),  # the same frame again and again
    ("stream", Kind.SLOW, ""),  # `value` times the usual rate, 0.2 unless given
    ("stream", Kind.DELAYED, ""),  # sent `value` seconds after they were taken, 1.5 unless given; at most 5
    ("stream", Kind.INTERMITTENT, ""),  # gone for `value` seconds, there for as long, and so on; 2 unless given
    ("stream", Kind.WRONG, "serial"),  # another camera
    ("stream", Kind.WRONG, "resolution"),  # another mode than was asked for
    ("stream", Kind.WRONG, "usb2"),  # a camera on a USB 2 cable
}

# These change what the camera is; a client meets them as if it had been plugged in anew.
_REPLUG = ("serial", "resolution", "usb2")
_PERIOD_S = 1 / FRAMES_PER_S
_IDLE_S = 0.1
_LONGEST_DELAY_S = 5.0
_MOST_CLIENTS = 8


def serve_camera(
    host: str,
    port: int,
    config: CellConfig,
    visuals: tuple[Visual, ...],
    poses: str,
    faults: Connection,
    ready: Connection,
) -> None:
    """Run until SIGTERM, or until the supervisor at the other end of `faults` is gone.

    Args:
        host: address to listen at.
        port: likewise; 0 for any.
        config: of the twin that is served: mount of the camera, noise, seed.
        visuals: what there is to see.
        poses: name of the record with their poses.
        faults: over which the supervisor sends the faults.
        ready: is sent {"camera": "host:port"}, or {"error": ...}.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    server = CameraServer(host, port, config, visuals, poses, faults)
    try:
        try:
            server.open()
        except CellError as error:
            ready.send({"error": f"camera: {error}"})
            return
        ready.send({"camera": f"{host}:{server.port}"})
        server.run()
    finally:
        server.close()


class CameraServer:
    """The served camera; arguments as of `serve_camera`."""

    def __init__(
        self,
        host: str,
        port: int,
        config: CellConfig,
        visuals: tuple[Visual, ...],
        poses: str,
        faults: Connection,
    ) -> None:
        self.port = port
        self._host = host
        self._mount = config.camera
        self._options = TwinOptions.model_validate(config.backend.options)
        self._visuals = visuals
        self._poses = Record(poses_dtype(len(visuals)), poses)
        self._connection = faults
        self._faults = FaultInbox(faults, "camera")
        self._faults_since = time.monotonic()
        self._replug: tuple[bool, ...] = (False,) * len(_REPLUG)
        self._listener: socket.socket | None = None
        self._clients: list[Client] = []
        self._streams: dict[str, _Stream] = {}
        self._start = time.monotonic()

    def open(self) -> None:
        """Take the port, and load the renderer.

        Raises:
            ConfigError: the port is not free, or the renderer is not installed.
        """
        self._listen()
        load_open3d()

    def run(self) -> None:
        """Serve until the supervisor is gone."""
        turn = 0
        try:
            while True:
                busy = bool(self._clients)
                self._attend_until(self._start + (turn + 1) * _PERIOD_S if busy else time.monotonic() + _IDLE_S)
                # Turns that have passed meanwhile are skipped.
                turn = max(turn + 1, int((time.monotonic() - self._start) / _PERIOD_S))
                self._plug_in_or_out()
                self._serve_clients(turn)
        except EOFError:
            return

    def close(self) -> None:
        """End every connection and let go of the port and the memory. Idempotent."""
        self._unplug()
        self._poses.close()

    def _attend_until(self, deadline: float) -> None:
        """Take in new clients and faults, at least those that wait already."""
        while True:
            sources: list[Connection | socket.socket] = [self._connection]
            if self._listener is not None:
                sources.append(self._listener)
            for source in wait(sources, max(0.0, deadline - time.monotonic())):
                if source is self._listener:
                    self._accept()
                elif self._faults.poll():
                    self._faults_since = time.monotonic()
            if time.monotonic() >= deadline:
                return

    def _accept(self) -> None:
        if self._listener is not None:
            with contextlib.suppress(OSError):  # it has gone again, or there are no descriptors left
                connection = self._listener.accept()[0]
                if len(self._clients) < _MOST_CLIENTS:
                    self._clients.append(Client(connection))
                else:
                    connection.close()

    def _plug_in_or_out(self) -> None:
        replug = tuple(self._faults.find("stream", Kind.WRONG, what) is not None for what in _REPLUG)
        if replug != self._replug:
            self._replug = replug
            self._unplug()
        gone = self._faults.find("stream", Kind.OFF) is not None
        intermittent = self._faults.find("stream", Kind.INTERMITTENT)
        if intermittent is not None:
            gone |= (time.monotonic() - self._faults_since) // (intermittent.value or 2.0) % 2 == 0
        if gone:
            self._unplug()
        elif self._listener is None:
            self._listen()

    def _listen(self) -> None:
        try:
            self._listener = socket.create_server((self._host, self.port))
        except OSError as error:
            raise ConfigError(
                f"port {self.port} of {self._host} cannot be opened ({error.strerror}): is another cell served there? "
                "Choose another port"
            ) from error
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])

    def _unplug(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        clients, self._clients = self._clients, []
        for client in clients:
            client.close()
        self._streams = {}

    def _serve_clients(self, turn: int) -> None:
        for client in [client for client in self._clients if client.gone]:
            self._clients.remove(client)
            client.close()
        watched: dict[str, list[Client]] = {}
        for client in self._clients:
            if client.request is not None:
                watched.setdefault(self._mode(client.request.resolution), []).append(client)
        self._streams = {mode: stream for mode, stream in self._streams.items() if mode in watched}
        for mode, clients in watched.items():
            for client in clients:
                if not client.described:
                    client.described = client.offer(encode(self._describe(mode)))
            if not self._poses.written:
                continue
            if mode not in self._streams:
                self._streams[mode] = _Stream(self._renderer(mode), self._faults, turn)
            for message in self._streams[mode].messages(self._poses, turn):
                for client in clients:
                    client.offer(message)

    def _mode(self, requested: str) -> str:
        """The mode that is served to who asks for one."""
        mode = requested if requested in MODES else self._mount.resolution
        if self._faults.find("stream", Kind.WRONG, "resolution") is not None:
            mode = next(other for other in MODES if other != mode)
        return mode

    def _renderer(self, mode: str) -> Renderer:
        mount = self._mount.model_copy(update={"resolution": mode})
        return Renderer(self._visuals, mount, self._options)

    def _describe(self, mode: str) -> Description:
        wrong_serial, _, usb2 = self._replug
        return describe(
            reported_intrinsics(mode, self._options), WRONG_SERIAL if wrong_serial else SERIAL, "2.1" if usb2 else "3.2"
        )


class _Stream:
    """One mode while somebody looks at it, and what is wrong with its stream."""

    def __init__(self, renderer: Renderer, faults: FaultInbox, turn: int) -> None:
        self._maker = ImageMaker(renderer, faults)
        self._faults = faults
        self._first_turn = turn
        self._last: bytes | None = None
        self._held: deque[tuple[float, bytes]] = deque()

    def messages(self, poses: Record, turn: int) -> list[bytes]:
        """What is to be sent in a turn."""
        now = time.monotonic()
        slow = self._faults.find("stream", Kind.SLOW)
        if slow is None or turn % max(1, round(1 / (slow.value or 0.2))) == 0:
            delay = self._faults.find("stream", Kind.DELAYED)
            late_s = 0.0 if delay is None else min(delay.value or 1.5, _LONGEST_DELAY_S)
            self._held.append((now + late_s, self._next(poses, turn)))
        due = []
        while self._held and self._held[0][0] <= now:
            due.append(self._held.popleft()[1])
        return due

    def _next(self, poses: Record, turn: int) -> bytes:
        if self._last is None or self._faults.find("stream", Kind.STUCK) is None:
            now = poses.read()["poses"]
            self._last = encode(self._maker.make(now, time.time(), turn, turn - self._first_turn))
        return self._last
