"""The process of the UR controller: one thread that serves all ports and keeps the control period.

Ports: dashboard 29999, primary 30001, secondary 30002, script and realtime stream 30003, RTDE 30004; 30011 to 30013 are
the streams without scripts. A period begins at its absolute time; between two, the sockets are read. Nothing here waits
for a client or for the world.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.errors import ConfigError
from sim_twin.wire.faults import FaultInbox, Kind
from sim_twin.wire.shared_state import ARM_COMMAND, CELL_STATE, PERIOD_S, Record
from sim_twin.wire.ur.controller import Controller
from sim_twin.wire.ur.dashboard import GREETING, DashboardSession
from sim_twin.wire.ur.launch import launch
from sim_twin.wire.ur.ports import Client, Port, Session, UnreadAnswersError
from sim_twin.wire.ur.rtde import ProtocolError, RtdeSession
from sim_twin.wire.ur.script_reader import ScriptReader
from sim_twin.wire.ur.snapshot import Snapshot
from sim_twin.wire.ur.state_faults import STATE_FAULTS, StateFaults
from sim_twin.wire.ur.streams import STATE_PERIOD_S, realtime_packet, report_message, robot_state, version_message

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

ARM_FAULTS: frozenset[tuple[str, Kind, str]] = frozenset(
    {
        ("rtde", Kind.OFF, ""),
        ("rtde", Kind.STUCK, ""),
        ("rtde", Kind.GARBAGE, ""),
        ("rtde", Kind.GARBAGE, "zero_length"),
        ("rtde", Kind.SLOW, ""),
        ("rtde", Kind.DELAYED, ""),
        ("rtde", Kind.INTERMITTENT, ""),
        ("rtde", Kind.WRONG, "version"),
        ("rtde", Kind.WRONG, "in_use"),
        ("rtde", Kind.WRONG, "not_found"),
        ("dashboard", Kind.OFF, ""),
        ("dashboard", Kind.STUCK, ""),
        ("dashboard", Kind.GARBAGE, ""),
        ("dashboard", Kind.DELAYED, ""),
        ("script", Kind.OFF, ""),
        ("script", Kind.STUCK, ""),
        ("ik", Kind.WRONG, "none"),
        *(("state", Kind.WRONG, what) for what in STATE_FAULTS),
    }
)

# Held up for longer than this, the controller leaves the missed periods out instead of making up for them.
_MAX_LAG_S = 0.02
# Of a period, at most so much is spent on what clients have sent; the system takes the processor away from a process of
# real-time priority that leaves less than 5 % of it.
_SHARE = 0.25
_REPORTS_PER_PERIOD = 8
_STATE_TICKS = round(STATE_PERIOD_S / PERIOD_S)
# A header that says less than its own length; a data package without data; a line that is no word of the dashboard.
_BAD_HEADER = b"\x00\x01\xff\xff\x00\x00"
_EMPTY_PACKAGE = b"\x00\x03U"
_BAD_LINE = b"\xff\x00\xfe\x81?\n"


def serve_ur(
    host: str,
    q: tuple[float, ...],
    unlock_after_s: float,
    arm_command: str,
    cell_state: str,
    faults: Connection,
    ready: Connection,
) -> None:
    """Be the UR controller of a served cell until SIGTERM comes or the supervisor is gone.

    Args:
        host: address that the ports are opened on.
        q: (6,) joint angles [rad] at the start.
        unlock_after_s: how long after a protective stop the arm can be unlocked.
        arm_command: name of the record that is written.
        cell_state: name of the record that is read.
        faults: from which the faults come.
        ready: where the endpoints go, or {"error": text} when a port cannot be opened.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The library of inverse kinematics writes warnings to standard output; who does not read them must not hold us up.
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    server = _Server(host, Controller(np.array(q), unlock_after_s), faults)
    signal.signal(signal.SIGTERM, lambda *_: server.stop())
    command, state = Record(ARM_COMMAND, arm_command), Record(CELL_STATE, cell_state)
    try:
        try:
            endpoints = server.open()
        except ConfigError as error:
            ready.send({"error": str(error)})
            return
        ready.send(endpoints)
        # What exists now stays; the collector need not look at it again.
        gc.freeze()
        server.run(command, state)
    finally:
        server.close()
        command.close()
        state.close()


class _ScriptSession:
    """One connection of a port that takes scripts."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._reader = ScriptReader()

    def feed(self, data: bytes) -> None:
        self._reader.feed(data)

    def step(self) -> bytes | None:
        if not self._reader.waiting:
            return None
        received = self._reader.read_line()
        if received is not None:
            launch(self._controller, received)
        return b""


class _ReadOnlySession:
    """One connection of a port that only sends."""

    def feed(self, data: bytes) -> None:
        pass

    def step(self) -> bytes | None:
        return None


class _Server:
    """All ports of one controller."""

    def __init__(self, host: str, controller: Controller, faults: Connection) -> None:
        self._controller = controller
        self._q = controller.arm.q.copy()
        self._connection = faults
        self._inbox = FaultInbox(faults, "arm")
        self._state_faults = StateFaults(self._controller)
        # Clients from whom something has come that was not looked at yet, in the order of their turns.
        self._waiting: dict[Client, Port] = {}
        # The faults of now, by channel, kind and what.
        self._present: frozenset[tuple[str, Kind, str]] = frozenset()
        self._claims: dict[str, RtdeSession] = {}
        self._running = True
        self._started = time.monotonic()
        self._rtde = Port("rtde", host, 30004)
        self._dashboard = Port("dashboard", host, 29999)
        self._script = Port("script", host, 30003)
        self._primary = [Port("primary", host, 30001), Port("primary read-only", host, 30011)]
        self._secondary = [Port("secondary", host, 30002), Port("secondary read-only", host, 30012)]
        self._realtime = [self._script, Port("realtime read-only", host, 30013)]
        self._ports = [self._rtde, self._dashboard, *self._primary, *self._secondary, *self._realtime]

    def open(self) -> dict[str, str]:
        """Open all ports; returns where they are."""
        for port in self._ports:
            port.open()
        return {port.name: "{}:{}".format(*port.address) for port in self._ports}

    def stop(self) -> None:
        """Let `run` end."""
        self._running = False

    def close(self) -> None:
        """Close everything. Idempotent."""
        for port in self._ports:
            port.close()
            for client in list(port.clients):
                self._drop(port, client)

    def run(self, command: Record, state: Record) -> None:
        """Keep the control period until `stop`, or until the supervisor is gone."""
        deadline = time.monotonic()
        while self._running:
            deadline += PERIOD_S
            self._listen_until(deadline)
            now = time.monotonic()
            if now - deadline > _MAX_LAG_S:
                missed = int((now - deadline) / PERIOD_S)
                self._controller.skip(missed)
                deadline += missed * PERIOD_S
            self._tick(now, command, state)

    def _tick(self, now: float, command: Record, state: Record) -> None:
        controller = self._controller
        controller.tick(now, state.read() if state.written else self._at_rest(now))
        arm = controller.arm
        command.write(
            tick=controller.ticks,
            powered=controller.powered,
            q=arm.q,
            T_flange_tcp=arm.T_flange_tcp,
            payload_kg=controller.payload.mass,
        )
        self._send(now, Snapshot(controller))
        controller.execution_time = time.monotonic() - now

    def _at_rest(self, now: float) -> np.void:
        """What a world that has not begun yet would say."""
        cells = np.zeros(1, CELL_STATE)
        cells["wall"], cells["q"] = now, self._q
        return cells[0]  # type: ignore[no-any-return]

    # Reading

    def _listen_until(self, deadline: float) -> None:
        """Serve the sockets until a time, at least once."""
        for port in (self._rtde, self._dashboard, self._script):
            self._follow_fault(port)
        until = time.monotonic() + _SHARE * PERIOD_S
        while True:
            self._obey(until)
            readers: dict[Any, tuple[Port, Client | None]] = {}
            for port in self._ports:
                if port.listener is not None:
                    readers[port.listener] = (port, None)
                if not self._stuck(port):
                    listened = [client for client in port.clients if client.sends and client not in self._waiting]
                    readers.update({client.connection: (port, client) for client in listened})
            timeout = max(0.0, deadline - time.monotonic())
            ready, _, _ = select.select([self._connection, *readers], [], [], timeout)
            for reader in ready:
                if reader is self._connection:
                    self._take_faults()
                    continue
                port, client = readers[reader]
                if client is None:
                    self._welcome(port)
                elif client in port.clients:
                    self._read(port, client)
            if time.monotonic() >= deadline or not ready:
                return

    def _obey(self, until: float) -> None:
        """Carry out what clients have sent, each client a message in turn, until a time.

        However much a client sends, and however long it takes to read, the period is kept, and the processor is left to
        others for a part of it.
        """
        turns = deque(item for item in self._waiting.items() if not self._stuck(item[1]))
        while turns and time.monotonic() < until:
            client, port = turns.popleft()
            if client in self._waiting and self._step(port, client):
                turns.append((client, port))

    def _step(self, port: Port, client: Client) -> bool:
        """Obey one message of a client, if there is a whole one; whether there was."""
        try:
            answer = client.session.step()
        except ProtocolError:
            self._drop(port, client)
            return False
        if answer is not None:
            self._put(port, client, answer)
            return True
        self._waiting.pop(client, None)
        self._flush(port, client)
        if not client.sends:
            self._drop(port, client)
        return False

    def _welcome(self, port: Port) -> None:
        connection = port.accept()
        if connection is None:
            return
        now = time.monotonic()
        try:
            client = Client(connection, self._session(port), now)
        except OSError:
            connection.close()
            return
        if port.full and not self._make_room(port):
            client.close()
            return
        client.outbox.delay_s = self._delay_s(port)
        port.clients.append(client)
        if port is self._dashboard:
            self._put(port, client, GREETING)
        elif port in (*self._primary, *self._secondary):
            self._put(port, client, version_message())

    def _make_room(self, port: Port) -> bool:
        """Hang up on the client that has been silent for longest, first of all on those that never said anything."""
        silent = [client for client in port.clients if not _streams(client)]
        if not silent:
            return False
        self._drop(port, min(silent, key=lambda client: (client.has_spoken, client.heard_at)))
        return True

    def _session(self, port: Port) -> Session:
        if port is self._rtde:
            return RtdeSession(self._controller, self._claims, lambda what: self._has("rtde", Kind.WRONG, what))
        if port is self._dashboard:
            return DashboardSession(self._controller)
        return _ReadOnlySession() if "read-only" in port.name else _ScriptSession(self._controller)

    def _read(self, port: Port, client: Client) -> None:
        if client.read(time.monotonic()):
            self._waiting[client] = port
            # One message at once: a command counts in the period in which it comes.
            if self._step(port, client):
                self._flush(port, client)
        elif not client.sends:
            self._drop(port, client)

    def _take_faults(self) -> None:
        try:
            changed = self._inbox.poll()
        except (EOFError, OSError):
            self.stop()
            return
        if changed:
            self._state_faults.apply(self._inbox)
            self._present = frozenset(fault for fault in ARM_FAULTS if self._inbox.find(*fault))
            for port in self._ports:
                for client in port.clients:
                    client.outbox.delay_s = self._delay_s(port)

    # Sending

    def _send(self, now: float, snapshot: Snapshot) -> None:
        controller = self._controller
        slow = self._inbox.find("rtde", Kind.SLOW)
        every = 1 if slow is None else max(1, round(1 / max(slow.value or 0.1, 1e-3)))
        if not self._stuck(self._rtde) and controller.ticks % every == 0:
            self._send_packages(now, snapshot, controller.ticks // every)
        self._send_streams(now, snapshot)
        for port in self._ports:
            if self._stuck(port):
                continue
            for client in list(port.clients):
                self._flush(port, client)

    def _send_packages(self, now: float, snapshot: Snapshot, tick: int) -> None:
        for client in self._rtde.clients:
            assert isinstance(client.session, RtdeSession)
            package = client.session.package(snapshot, tick)
            if package is not None:
                client.send(self._garbled(self._rtde, package), now, droppable=True)

    def _send_streams(self, now: float, snapshot: Snapshot) -> None:
        controller = self._controller
        for _ in range(min(len(controller.reports), _REPORTS_PER_PERIOD)):
            message = report_message(controller.time, controller.reports.popleft())
            for port in self._primary:
                for client in port.clients:
                    client.send(message, now, droppable=True)
        if controller.ticks % _STATE_TICKS == 0:
            streams = [client for port in (*self._primary, *self._secondary) for client in port.clients]
            message = robot_state(controller, snapshot) if streams else b""
            for client in streams:
                client.send(message, now, droppable=True)
        ports = [port for port in self._realtime if not self._stuck(port)]
        readers = [client for port in ports for client in port.clients if not client.outbox.blocked]
        packet = realtime_packet(snapshot) if readers else b""
        for client in readers:
            client.send(packet, now, droppable=True)

    def _put(self, port: Port, client: Client, data: bytes) -> None:
        if data:
            client.send(self._garbled(port, data), time.monotonic(), droppable=False)

    def _flush(self, port: Port, client: Client) -> None:
        try:
            client.flush(time.monotonic())
        except UnreadAnswersError:
            self._drop(port, client)
            return
        if isinstance(client.session, DashboardSession) and client.session.ended and client.outbox.empty:
            self._drop(port, client)

    def _drop(self, port: Port, client: Client) -> None:
        if isinstance(client.session, RtdeSession):
            client.session.close()
        client.close()
        self._waiting.pop(client, None)
        if client in port.clients:
            port.clients.remove(client)

    # Faults of the links

    def _garbled(self, port: Port, data: bytes) -> bytes:
        if self._has(port.name, Kind.GARBAGE):
            return _BAD_HEADER if port is self._rtde else _BAD_LINE
        return _EMPTY_PACKAGE if self._has(port.name, Kind.GARBAGE, "zero_length") else data

    def _has(self, channel: str, kind: Kind, what: str = "") -> bool:
        return (channel, kind, what) in self._present

    def _stuck(self, port: Port) -> bool:
        return self._has(port.name, Kind.STUCK)

    def _delay_s(self, port: Port) -> float:
        fault = self._inbox.find(port.name, Kind.DELAYED)
        return 0.0 if fault is None else max(fault.value or 0.0, 0.0)

    def _follow_fault(self, port: Port) -> None:
        """Close a port that is to be off, with its clients; open it again when that is over."""
        gone = self._has(port.name, Kind.OFF)
        coming_and_going = self._inbox.find(port.name, Kind.INTERMITTENT)
        if coming_and_going is not None:
            since = time.monotonic() - self._started
            gone = int(since / max(coming_and_going.value or 1.0, 0.01)) % 2 == 1
        if gone:
            port.close()
            for client in list(port.clients):
                self._drop(port, client)
        elif port.listener is None:
            # Where somebody else has taken it meanwhile, it is tried again in the next period.
            with contextlib.suppress(ConfigError):
                port.open()


def _streams(client: Client) -> bool:
    """Whether a client gets data packages, and so need not say anything."""
    return isinstance(client.session, RtdeSession) and client.session.streaming
