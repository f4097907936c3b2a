"""Programs as the controller runs them: threads that take turns, each doing its part of one control period."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeAlias

# Yields once per control period. A motion is a thread that commands one joint target before each yield.
Thread: TypeAlias = Generator[None, None, None]

_LARGEST = 1e6


class ScriptError(Exception):
    """A program does what the controller refuses; it dies with this message.

    Args:
        message: what the twin says of it.
        line: of the program, from 1; 0 where no line is to blame.
        words: what the controller says of it; the message, unless given.
    """

    def __init__(self, message: str, line: int = 0, words: str | None = None) -> None:
        super().__init__(f"line {line}: {message}" if line else message)
        self.line = line
        self.words = message if words is None else words


def checked(number: float) -> float:
    """A number that a program may use.

    Raises:
        ScriptError: it is none, or so large that no robot has a use for it.
    """
    if not abs(number) <= _LARGEST:
        raise ScriptError(f"{number} is no number that the controller can use")
    return number


class Program:
    """A main thread and those that it starts.

    Args:
        name: of the program.
        main: thread; the program ends with it.
    """

    def __init__(self, name: str, main: Thread) -> None:
        self.name = name
        self._main = main
        self._threads: list[Thread] = [main]

    def run(self, thread: Thread) -> Thread:
        """Start a thread; its turn comes in this period. Returns it, for `kill`."""
        self._threads.append(thread)
        return thread

    def kill(self, thread: Thread | None) -> None:
        """End a thread; None and ended ones are ignored."""
        self._threads = [other for other in self._threads if other is not thread]

    def alive(self, thread: Thread | None) -> bool:
        """Whether a thread has not ended."""
        return any(other is thread for other in self._threads)

    def step(self) -> bool:
        """Let every thread do its part of a period; whether the main thread goes on.

        Raises:
            ScriptError: a thread does what the controller refuses.
        """
        done = 0
        while done < len(self._threads):
            thread = self._threads[done]
            try:
                next(thread)
            except StopIteration:
                if thread is self._main:
                    return False
                self.kill(thread)
                continue
            # A thread may have killed one before it.
            if done < len(self._threads) and self._threads[done] is thread:
                done += 1
        return True
