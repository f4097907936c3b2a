"""The keyboard while a job runs: Space holds it, and Space again lets it go on."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from typing_extensions import Self

_SPACE = b" "


class KeyboardHold:
    """A `Hold` that listens to the terminal; a context manager. Where there is no terminal it never holds.

    Args:
        say: told in words when the operator holds the job or lets it go on.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._may_go_on = threading.Event()
        self._may_go_on.set()
        self._thread: threading.Thread | None = None
        self._before: list[Any] = []
        self._end: tuple[int, int] = (-1, -1)

    def __enter__(self) -> Self:
        # A command in the background must leave the terminal to the one in front.
        if sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp():
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
            self._end = os.pipe()
            self._thread = threading.Thread(target=self._listen, name="keyboard", daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._thread is None:
            return
        os.close(self._end[1])
        self._thread.join()
        os.close(self._end[0])
        self._thread = None
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def __call__(self) -> bool:
        """Wait while the operator holds the job; whether that was so."""
        if self._may_go_on.is_set():
            return False
        self._say("held: the arm stands still; Space goes on")
        self._may_go_on.wait()
        return True

    def _listen(self) -> None:
        stdin = sys.stdin.fileno()
        while True:
            ready, _, _ = select.select([stdin, self._end[0]], [], [])
            key = b"" if self._end[0] in ready else os.read(stdin, 1)
            if not key:
                return
            if key != _SPACE:
                continue
            if self._may_go_on.is_set():
                self._may_go_on.clear()
                self._say("hold after this action; Space goes on")
            else:
                # Said first: the job prints its own lines as soon as it goes on.
                self._say("going on")
                self._may_go_on.set()
