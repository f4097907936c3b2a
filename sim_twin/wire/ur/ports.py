"""The sockets of the UR controller: ports, their clients, and sending that never waits."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from typing import Protocol

from robotcell.errors import ConfigError

# A client that does not read: so much of what is sent waits in the kernel, then packages are dropped, oldest first.
_SEND_BUFFER = 64 * 1024
# Answers are never dropped; a client that asks and asks and never reads is closed instead.
_MAX_WAITING_ANSWERS = 1000
_MAX_CLIENTS = 32
# So little at a time that a client that floods its connection cannot hold up the period; the rest waits in the kernel.
_READ_SIZE = 4096


class Session(Protocol):
    """One connection's protocol."""

    def feed(self, data: bytes) -> None:
        """Take bytes in, whole messages or not."""
        ...

    def step(self) -> bytes | None:
        """Obey the next whole message; the answer to it, or None when there is none."""
        ...


class UnreadAnswersError(Exception):
    """A client asks and asks, and never reads an answer."""


class Outbox:
    """What is on its way to one client.

    Attributes:
        delay_s: how late everything is sent.
    """

    def __init__(self) -> None:
        self.delay_s = 0.0
        self._partial = b""
        self._waiting: deque[tuple[float, bytes, bool]] = deque()

    @property
    def blocked(self) -> bool:
        """Whether the client has not taken what was sent before."""
        return bool(self._partial)

    @property
    def empty(self) -> bool:
        """Whether everything has been sent."""
        return not self._partial and not self._waiting

    def put(self, data: bytes, now: float, *, droppable: bool) -> None:
        """Send these bytes, all or, where `droppable`, perhaps none of them."""
        self._waiting.append((now + self.delay_s, data, droppable))

    def clear(self) -> None:
        """Send nothing of what waits."""
        self._partial = b""
        self._waiting.clear()

    def flush(self, connection: socket.socket, now: float) -> None:
        """Hand over what is due, as far as the client takes it.

        Raises:
            OSError: the connection is lost.
            UnreadAnswersError: the client never reads what it asks for.
        """
        while self._partial or (self._waiting and self._waiting[0][0] <= now):
            data = self._partial or self._waiting.popleft()[1]
            try:
                sent = connection.send(data)
            except BlockingIOError:
                sent = 0
            self._partial = data[sent:]
            if self._partial:
                self._drop(now)
                return

    def _drop(self, now: float) -> None:
        """Keep only the newest of the packages that are due."""
        due = [item for item in self._waiting if item[0] <= now]
        packages = sum(droppable for _, _, droppable in due)
        if packages > 1:
            kept = []
            for item in self._waiting:
                if item[2] and item[0] <= now and packages > 1:
                    packages -= 1
                    continue
                kept.append(item)
            self._waiting = deque(kept)
        if len(due) - packages > _MAX_WAITING_ANSWERS:
            raise UnreadAnswersError


class Client:
    """One connection to a port.

    Args:
        connection: of the client; becomes non-blocking.
        session: of its protocol.
        now: time.monotonic() [s].

    Attributes:
        outbox: what is on its way to it.
        heard_at: when it last sent something; until then, when it came.
        has_spoken: whether it ever sent anything.
        sends: nothing more comes from a client that has closed its side.
    """

    def __init__(self, connection: socket.socket, session: Session, now: float) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self.connection = connection
        self.session = session
        self.outbox = Outbox()
        self.heard_at = now
        self.has_spoken = False
        self.sends = True
        # What it sent before it closed is obeyed even where nothing can be sent to it any longer.
        self._takes = True

    def read(self, now: float) -> bool:
        """Hand what has come to the session; whether anything has."""
        try:
            data = self.connection.recv(_READ_SIZE)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self.sends = False
            return False
        self.heard_at, self.has_spoken = now, True
        self.session.feed(data)
        return True

    def send(self, data: bytes, now: float, *, droppable: bool) -> None:
        """Send these bytes, all or, where `droppable`, perhaps none of them."""
        if self._takes:
            self.outbox.put(data, now, droppable=droppable)

    def flush(self, now: float) -> None:
        """Hand over what is due, as far as the client takes it.

        Raises:
            UnreadAnswersError: the client never reads what it asks for.
        """
        try:
            self.outbox.flush(self.connection, now)
        except OSError:
            self._takes = False
            self.outbox.clear()

    def close(self) -> None:
        """End the connection. Idempotent."""
        with contextlib.suppress(OSError):
            self.connection.close()


class Port:
    """One listening port.

    Args:
        name: of what is served there.
        host: to listen on.
        number: of the port.
    """

    def __init__(self, name: str, host: str, number: int) -> None:
        self.name = name
        self.address = (host, number)
        self.clients: list[Client] = []
        self.listener: socket.socket | None = None

    def open(self) -> None:
        """Listen. Does nothing when it listens.

        Raises:
            ConfigError: something else listens there, or the address is not this machine's.
        """
        if self.listener is not None:
            return
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(self.address)
            listener.listen()
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            host, number = self.address
            raise ConfigError(
                f"port {number} of {host} ({self.name} of the arm) cannot be opened: {error.strerror}. End what uses "
                "it, or serve on another address, such as --host 127.0.0.3"
            ) from None
        self.listener = listener

    def accept(self) -> socket.socket | None:
        """A client that has called, None if it has gone again."""
        if self.listener is None:
            return None
        try:
            connection, _ = self.listener.accept()
        except OSError:
            return None
        return connection

    @property
    def full(self) -> bool:
        """Whether it has all the clients that it can have."""
        return len(self.clients) >= _MAX_CLIENTS

    def close(self) -> None:
        """Stop listening. Idempotent; the clients stay."""
        if self.listener is not None:
            self.listener.close()
            self.listener = None
