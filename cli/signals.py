"""What a signal does to a command: it ends as by an error, so that the arm is stopped and the record is kept."""

from __future__ import annotations

import signal
import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

# A command that was told to end stops the arm and closes the cell within 2 s. Until it is clear that it hangs, nothing
# may interrupt it: neither an impatient second Ctrl-C, nor the second signal that `timeout` and some shells send.
_ENDING_S = 5.0


def end_cleanly_on_signals() -> None:
    """From now on SIGINT raises KeyboardInterrupt, SIGTERM and SIGHUP raise SystemExit: the first of them, for 5 s."""
    ending_since = -_ENDING_S

    def end(number: int, _frame: FrameType | None) -> None:
        nonlocal ending_since
        now = time.monotonic()
        if now - ending_since < _ENDING_S:
            return
        ending_since = now
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
