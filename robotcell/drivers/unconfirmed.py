"""A driver that no device has confirmed says so, once, when it connects."""

from __future__ import annotations

import functools
import logging

_LOG = logging.getLogger(__name__)


@functools.cache
def warn_unconfirmed(device: str) -> None:
    """Warn that the driver of a device was only ever run against the served twin."""
    _LOG.warning(
        "the %s driver was verified against the served twin only, not yet against a device: follow "
        "docs/tutorials/real-cell.md",
        device,
    )
