"""Programs out of the stream of bytes that a client sends: a block from its header to its end, or a single line.

Understood are the control script of ur_rtde, which runs natively, programs of plain statements, and the commands that
UR's own client library sends as lines. Blocks are counted, whatever their headers say: a program with anything in it
that is not understood is refused whole, and nothing of it is taken for another program.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from sim_twin.wire.ur.program import ScriptError
from sim_twin.wire.ur.script import move_of, not_understood, number_of, parse_statement
from sim_twin.wire.ur.statements import check_statement

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sim_twin.wire.ur.moves import Move
    from sim_twin.wire.ur.script import Statement

# The control script is 50 kB long, a megabyte some ten thousand moves.
MAX_PROGRAM_BYTES = 1 << 20
MAX_PROGRAM_LINES = 20_000
MAX_LINE_BYTES = 2048
# A secondary program runs within one period.
MAX_SECONDARY_STATEMENTS = 20

# Without and with FLAG_UPPER_RANGE_REGISTERS.
REGISTER_OFFSETS = (0, 24)

COMMANDS = frozenset({"power on", "power off", "set robotmode run", "set unlock protective stop", "stop program"})

_STRING = re.compile(r"\"[^\"]*\"|'[^']*'")
_OPENS = re.compile(r"\b(?:def|sec|thread|if|while|for)\b")
_ENDS = re.compile(r"\bend\b")
_GOES_ON = re.compile(r"(?:elif|else)\b")
_HEADER = re.compile(r"(def|sec)\s+(\w+)\s*\(\s*\)\s*:$")
_MARK = "RTDE Control script - Main loop"
_PATH_BEGINS = "# inject move path"
_OFFSET = re.compile(r"reg_offset_int\s*=\s*(\d*)")
_DIGITS = re.compile(r"\s*(\d{1,9})\b")


@dataclass(frozen=True)
class Script:
    """A program of plain statements.

    Attributes:
        name: of the program.
        lines: number, from 1, and text of each line that says something.
        secondary: it runs beside the main program ("sec").
    """

    name: str
    lines: tuple[tuple[int, str], ...]
    secondary: bool = False

    def statements(self) -> Iterator[Statement]:
        """What the program does; each statement is read when it is asked for."""
        return (parse_statement(code, line) for line, code in self.lines)


@dataclass(frozen=True)
class ControlScript:
    """The control script of ur_rtde.

    Attributes:
        register_offset: 0 or 24.
        path: moves that were injected into it.
    """

    register_offset: int = 0
    path: tuple[Move, ...] = ()


@dataclass(frozen=True)
class Command:
    """One of `COMMANDS`."""

    words: str


@dataclass(frozen=True)
class Refused:
    """A program of which nothing runs.

    Attributes:
        error: why, and in which line.
        secondary: it was to run beside the main program.
    """

    error: ScriptError
    secondary: bool = False


Received: TypeAlias = "Script | ControlScript | Command | Refused"


class ScriptReader:
    """Takes bytes as they come and reads them line by line."""

    def __init__(self) -> None:
        self._rest = b""
        self._waiting: deque[bytes] = deque()
        self._block: _Block | None = None

    @property
    def waiting(self) -> bool:
        """Whether there are whole lines that have not been read."""
        return bool(self._waiting)

    def feed(self, data: bytes) -> None:
        """Take bytes in, whole lines or not."""
        *ended, rest = (self._rest + data).split(b"\n")
        self._waiting.extend(ended)
        # Of a line that is too long only that it is matters.
        self._rest = rest[: MAX_LINE_BYTES + 1]

    def read_line(self) -> Received | None:
        """Read the next line: what is complete with it, or why a program is refused. None where neither is the case."""
        if not self._waiting:
            return None
        raw = self._waiting.popleft()
        too_long = len(raw) > MAX_LINE_BYTES
        text = "" if too_long else raw.decode("latin-1")
        code = _without_comment(text).strip()
        if self._block is None:
            if too_long:
                return Refused(_too_long(1))
            return self._begin(code)
        received = self._block.add(text, code, len(raw), too_long=too_long)
        if self._block.depth <= 0:
            self._block = None
        return received

    def _begin(self, code: str) -> Received | None:
        """A line outside of all blocks."""
        if not code:
            return None
        if (depth := _opened(code)) > 0:
            self._block = _Block(code, depth)
            return None
        if code in COMMANDS:
            return Command(code)
        try:
            check_statement(parse_statement(code, 1))
        except ScriptError as error:
            return Refused(error)
        return Script("unnamed", ((1, code),))


@dataclass
class _Block:
    """A program whose end has not come yet.

    Attributes:
        header: its first line.
        depth: blocks that are open.
    """

    header: str
    depth: int
    _line: int = 1
    _size: int = 0
    _lines: list[tuple[int, str]] = field(default_factory=list)
    _error: ScriptError | None = None
    # Refused already; the rest of it is passed over.
    _given_up: bool = False
    _is_control: bool = False
    _in_path: bool = False
    _path: list[Move] = field(default_factory=list)
    _path_error: ScriptError | None = None
    _waypoint: int = -1
    # None before the register offset was seen, -1 where it stands in the next line.
    _offset: int | None = None

    def __post_init__(self) -> None:
        if not _HEADER.match(self.header):
            self._error = not_understood(self.header, 1)

    def add(self, text: str, code: str, size: int, *, too_long: bool) -> Received | None:
        """Take the next line; what is complete with it."""
        self._line += 1
        self._size += size + 1
        self.depth += _opened(code)
        if code == "end":
            self._in_path = False
        if not self._given_up:
            refused = self._take(text, code, too_long=too_long)
            if refused is not None:
                return self._refuse(refused)
        return self._complete() if self.depth <= 0 else None

    def _take(self, text: str, code: str, *, too_long: bool) -> ScriptError | None:
        """Read a line; the error where the program is too large to be read any further."""
        if self._size > MAX_PROGRAM_BYTES or self._line > MAX_PROGRAM_LINES:
            self._given_up = True
            self._lines.clear()
            self._path.clear()
            return ScriptError(
                f"a program of more than {MAX_PROGRAM_BYTES} bytes or {MAX_PROGRAM_LINES} lines is not taken",
                self._line,
            )
        if too_long:
            self._error = self._error or _too_long(self._line)
        self._look_for_control_script(text, code)
        if code and self._error is None and not (code == "end" and self.depth <= 0):
            self._read(code)
        return None

    def _read(self, code: str) -> None:
        try:
            check_statement(parse_statement(code, self._line))
            self._lines.append((self._line, code))
        except ScriptError as error:
            self._error = error
            self._lines.clear()

    def _look_for_control_script(self, text: str, code: str) -> None:
        if _MARK in text:
            self._is_control = True
        elif text.strip() == _PATH_BEGINS:
            self._in_path = True
        elif self._in_path and code and self._path_error is None:
            self._read_path(code)
        if self._offset is None and (found := _OFFSET.search(text)):
            self._offset = int(found[1][:9]) if found[1] else -1
        elif self._offset == -1 and (found := _DIGITS.match(text)):
            self._offset = int(found[1])

    def _read_path(self, code: str) -> None:
        try:
            statement = parse_statement(code, self._line)
            if statement.name == "signal_async_progress":
                self._waypoint = int(number_of(statement, 0, "value", 0.0))
            else:
                self._path.append(move_of(statement, max(self._waypoint, 0)))
        except ScriptError as error:
            self._path_error = error

    def _complete(self) -> Received | None:
        if self._given_up:
            return None
        if self._is_control:
            return self._complete_control_script()
        header = _HEADER.match(self.header)
        if self._error is not None or header is None:
            return self._refuse(self._error or not_understood(self.header, 1))
        secondary = header[1] == "sec"
        if secondary and len(self._lines) > MAX_SECONDARY_STATEMENTS:
            return self._refuse(
                ScriptError(f"a secondary program of more than {MAX_SECONDARY_STATEMENTS} statements is not taken")
            )
        return Script(header[2], tuple(self._lines), secondary)

    def _complete_control_script(self) -> Received:
        if self._path_error is not None:
            return self._refuse(self._path_error)
        offset = max(self._offset or 0, 0)
        if offset not in REGISTER_OFFSETS:
            return self._refuse(ScriptError(f"a register offset of {offset}; the client has 0 and 24"))
        return ControlScript(offset, tuple(self._path))

    def _refuse(self, error: ScriptError) -> Refused:
        return Refused(error, secondary=re.match(r"sec\b", self.header) is not None)


def _opened(code: str) -> int:
    """How many more blocks a line opens than it ends. What ends in a colon opens one, whatever its words are."""
    words = _STRING.sub("", code) if "'" in code or '"' in code else code
    opened = len(_OPENS.findall(words))
    if opened == 0 and words.endswith(":") and not _GOES_ON.match(words):
        opened = 1
    return opened - len(_ENDS.findall(words))


def _without_comment(text: str) -> str:
    """A line up to the # that begins its comment; one inside a string is none."""
    if "#" not in text:
        return text
    quote = ""
    for i, character in enumerate(text):
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character == "#":
            return text[:i]
    return text


def _too_long(line: int) -> ScriptError:
    return ScriptError(f"a line of more than {MAX_LINE_BYTES} bytes is not taken", line)
