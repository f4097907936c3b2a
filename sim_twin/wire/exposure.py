"""Who can reach a served cell: it asks nobody who they are."""

from __future__ import annotations

import ipaddress
import socket

from robotcell.errors import ConfigError


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address or a name."""
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except OSError:
        return False


def check_exposure(host: str, *, expose: bool) -> None:
    """Check that a cell is served to other machines only where that is asked for.

    Raises:
        ConfigError: others can reach the address, and `expose` is not set.
    """
    if not expose and not is_loopback(host):
        raise ConfigError(
            f"{host} can be reached from other machines, and the twin asks nobody who they are: take an address such "
            "as 127.0.0.2, or say --expose"
        )
