"""The control socket of a served cell: faults at run time, a JSON line for a JSON line, for this machine only."""

from __future__ import annotations

import json
import selectors
import socket
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from pydantic import TypeAdapter, ValidationError

from robotcell.errors import CellError, ConfigError
from sim_twin.wire.exposure import is_loopback
from sim_twin.wire.faults import Fault

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from sim_twin.wire.cell import ServedCell

REQUESTS = (
    '{"inject": {"device", "channel", "kind", "what", "value"}}, {"clear": true}, {"list": true}, {"state": true}'
)
_FAULT = TypeAdapter(Fault)
_LONGEST_LINE = 10_000
_POLL_S = 0.1
_SEND_S = 1.0
_MOST_CLIENTS = 32


def handle(line: bytes, cell: ServedCell) -> dict[str, Any]:
    """The answer to one line: {"ok": true, ...} or {"ok": false, "error": text}."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict) or len(request) != 1:
            raise ConfigError(f"one request at a time; there are {REQUESTS}")
        ((verb, argument),) = request.items()
        return {"ok": True, **_obey(verb, argument, cell)}
    except ValidationError as error:
        problems = "; ".join(f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}" for detail in error.errors())
        return {"ok": False, "error": f"not a fault: {problems}"}
    except CellError as error:
        return {"ok": False, "error": str(error)}
    except RecursionError:
        return {"ok": False, "error": f"not a line of JSON that makes sense: nested too deeply; there are {REQUESTS}"}
    except ValueError as error:
        return {"ok": False, "error": f"not a line of JSON: {error}; there are {REQUESTS}"}


def _obey(verb: str, argument: object, cell: ServedCell) -> dict[str, Any]:
    if verb == "inject":
        cell.inject(_FAULT.validate_python(argument))
        return {}
    if argument is not True or verb not in {"clear", "list", "state"}:
        raise ConfigError(f"no such request; there are {REQUESTS}")
    if verb == "clear":
        cell.clear()
        return {}
    if verb == "list":
        active = [_FAULT.dump_python(fault, mode="json") for fault in cell.faults]
        return {"exist": cell.known_faults(), "active": active}
    state = cell.state()
    return {"state": {name: state[name].tolist() for name in state.dtype.names or ()}}


class ControlSocket:
    """Listens for control lines in a thread of its own.

    Args:
        cell: that gets the faults.
        host: address of the cell; the socket listens there where only this machine reaches it, else at 127.0.0.1.
        port: there; 0 for any.

    Attributes:
        endpoint: "host:port" where it listens.

    Raises:
        ConfigError: it cannot listen there.
    """

    def __init__(self, cell: ServedCell, host: str, port: int) -> None:
        host = host if is_loopback(host) else "127.0.0.1"
        self._cell = cell
        self._ended = threading.Event()
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise ConfigError(
                f"the control socket cannot listen at {host}:{port} ({error.strerror}): take another port"
            ) from error
        self.endpoint = f"{host}:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run, name="robotcell twin control", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Hang up and end. Idempotent."""
        self._ended.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        # Takes sockets of any number, unlike select.
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            clients: dict[socket.socket, _Received] = {}
            while not self._ended.is_set():
                for key, _ in selector.select(_POLL_S):
                    source = cast("socket.socket", key.fileobj)
                    if source is self._listener:
                        self._welcome(clients, selector)
                    elif source in clients and not self._serve(source, clients[source]):
                        _hang_up(source, clients, selector)
            for client in list(clients):
                _hang_up(client, clients, selector)

    def _welcome(self, clients: dict[socket.socket, _Received], selector: selectors.BaseSelector) -> None:
        """Take a client in; where there are too many, the one that has been silent for longest has to go."""
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        if len(clients) >= _MOST_CLIENTS:
            _hang_up(min(clients, key=lambda one: clients[one].at), clients, selector)
        client.settimeout(_SEND_S)
        clients[client] = _Received(time.monotonic())
        selector.register(client, selectors.EVENT_READ)

    def _serve(self, client: socket.socket, received: _Received) -> bool:
        """Answer what came; whether the client stays."""
        try:
            data = client.recv(4096)
            received.at = time.monotonic()
            received.data += data
            while b"\n" in received.data:
                line, _, received.data = received.data.partition(b"\n")
                client.sendall(json.dumps(handle(line, self._cell)).encode() + b"\n")
        except OSError:
            return False
        return bool(data) and len(received.data) < _LONGEST_LINE


@dataclass
class _Received:
    """What has come from a client and was not answered yet.

    Attributes:
        at: when it last said something, or came.
    """

    at: float
    data: bytes = b""


def _hang_up(client: socket.socket, clients: dict[socket.socket, _Received], selector: selectors.BaseSelector) -> None:
    selector.unregister(client)
    del clients[client]
    client.close()
