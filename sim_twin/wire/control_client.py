"""The other end of a served cell's control socket."""

from __future__ import annotations

import json
import socket
from typing import Any

from robotcell.errors import ConfigError, ConnectionLost

_TIMEOUT_S = 2.0


def ask(address: str, request: dict[str, Any]) -> dict[str, Any]:
    """The answer to one request; see `sim_twin.wire.control`.

    Args:
        address: "host:port" of the control socket.
        request: such as {"clear": True}.

    Raises:
        ConfigError: the address is none, or the cell refuses the request.
        ConnectionLost: nothing answers there.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(
            f"{address!r} is no control socket: give the address that `robotcell twin serve` prints, host:port"
        )
    try:
        with socket.create_connection((host, int(port)), timeout=_TIMEOUT_S) as link, link.makefile("rw") as lines:
            lines.write(json.dumps(request) + "\n")
            lines.flush()
            answer: dict[str, Any] = json.loads(lines.readline())
    except (OSError, ValueError) as error:
        raise ConnectionLost(
            f"no control socket answers at {address} ({error}): start `robotcell twin serve` with --control-port"
        ) from error
    if not answer["ok"]:
        raise ConfigError(answer["error"])
    return answer
