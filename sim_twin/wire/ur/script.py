"""URScript as far as the twin reads it: programs out of a stream of bytes, and their statements.

Understood are the control script of ur_rtde, which runs natively, and programs of plain statements with numbers, lists
and poses as arguments. Everything else ends in a `ScriptError` that names the line.
"""

from __future__ import annotations

import ast
import operator
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from sim_twin.wire.ur.moves import Move
from sim_twin.wire.ur.program import ScriptError, checked

if TYPE_CHECKING:
    from collections.abc import Callable

Value: TypeAlias = "float | int | bool | str | PoseValue | list[Value]"

# What a client may send before its program ends. The control script is 42 kB long.
_MAX_PROGRAM = 1 << 20

_HEAD = re.compile(rb"(def|sec)\s+(\w+)\s*\(\s*\)\s*:")
_OFFSET = re.compile(r"reg_offset_int\s*=\s*(?:#[^\n]*\n)?\s*(\d+)")
_PATH = re.compile(r"# inject move path\n(.*?)^\s*end\b", re.S | re.M)
_MARK = "RTDE Control script - Main loop"


@dataclass(frozen=True)
class PoseValue:
    """p[x, y, z, rx, ry, rz]."""

    numbers: tuple[float, ...]


@dataclass(frozen=True)
class Statement:
    """One call: its line in the program, the name, and the arguments."""

    line: int
    name: str
    arguments: tuple[Value, ...]
    keywords: dict[str, Value] = field(default_factory=dict)


@dataclass(frozen=True)
class Script:
    """A program as it came.

    Attributes:
        name: of the program.
        text: all of it.
        secondary: it runs beside the main program ("sec").
    """

    name: str
    text: str
    secondary: bool = False

    @property
    def is_control_loop(self) -> bool:
        """Whether this is the control script of ur_rtde."""
        return _MARK in self.text

    @property
    def register_offset(self) -> int:
        """Of the control script."""
        found = _OFFSET.search(self.text)
        return int(found[1]) if found else 0

    def path(self) -> list[Move]:
        """The moves that were injected into the control script.

        Raises:
            ScriptError: one of them is not understood.
        """
        found = _PATH.search(self.text)
        moves: list[Move] = []
        number = -1
        for i, text in enumerate(found[1].splitlines() if found else [], start=1):
            statement = parse_statement(text, i)
            if statement is None:
                continue
            if statement.name == "signal_async_progress":
                number = int(number_of(statement, 0, "value", 0.0))
            else:
                moves.append(move_of(statement, max(number, 0)))
        return moves

    def statements(self) -> list[Statement]:
        """What a program of plain statements does.

        Raises:
            ScriptError: a line is not understood; it says which.
        """
        lines = self.text.splitlines()
        body = lines[1:-1] if _HEAD.match(self.text.encode("latin-1")) else lines
        parsed = (parse_statement(text, i) for i, text in enumerate(body, start=2 if len(body) < len(lines) else 1))
        return [statement for statement in parsed if statement is not None]


class ScriptReader:
    """Cuts a stream into programs: a `def` or `sec` up to its `end`, and every other line by itself."""

    def __init__(self) -> None:
        self._rest = b""
        self._lines: list[bytes] = []
        self._size = 0

    def feed(self, data: bytes) -> list[Script]:
        """The programs that are complete with these bytes.

        Raises:
            ScriptError: a program grows beyond all bounds.
        """
        scripts: list[Script] = []
        *lines, self._rest = (self._rest + data).split(b"\n")
        for raw in lines:
            line = raw.rstrip(b"\r")
            if self._lines:
                self._lines.append(line)
                self._size += len(line) + 1
                if line.rstrip() == b"end":
                    scripts.append(_script(self._lines))
                    self._lines, self._size = [], 0
            elif _HEAD.match(line):
                self._lines, self._size = [line], len(line) + 1
            elif line.strip() and not line.lstrip().startswith(b"#"):
                scripts.append(_script([line.strip()]))
        if self._size + len(self._rest) > _MAX_PROGRAM:
            self._rest, self._lines, self._size = b"", [], 0
            raise ScriptError(f"a program of more than {_MAX_PROGRAM} bytes")
        return scripts


def parse_statement(text: str, line: int) -> Statement | None:
    """One line; None for an empty one or a comment.

    Raises:
        ScriptError: it is no call with plain arguments.
    """
    text = text.strip()
    if not text or text.startswith("#"):
        return None
    try:
        call = ast.parse(text, mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            raise ValueError("no call")
        arguments = tuple(_value(node) for node in call.args)
        keywords = {str(word.arg): _value(word.value) for word in call.keywords}
    except (SyntaxError, ValueError, RecursionError, MemoryError, ZeroDivisionError, OverflowError):
        raise ScriptError(f"line {line}: the twin does not understand {text[:60]!r}") from None
    return Statement(line, call.func.id, arguments, keywords)


def number_of(statement: Statement, index: int, name: str, default: float | None = None) -> float:
    """A number among the arguments of a statement, by place or by name.

    Raises:
        ScriptError: it is missing or no number.
    """
    value = argument(statement, index, name, default)
    if isinstance(value, (bool, int, float)):
        return checked(float(value))
    raise ScriptError(f"line {statement.line}: {statement.name}: {name} must be a number")


def numbers_of(statement: Statement, index: int, name: str, count: int) -> tuple[float, ...]:
    """A list or pose of numbers among the arguments of a statement.

    Raises:
        ScriptError: it is missing or something else.
    """
    value = argument(statement, index, name)
    numbers = value.numbers if isinstance(value, PoseValue) else value
    if not isinstance(numbers, (list, tuple)) or len(numbers) != count:
        raise ScriptError(f"line {statement.line}: {statement.name}: {name} must be {count} numbers")
    result = []
    for number in numbers:
        if not isinstance(number, (int, float)):
            raise ScriptError(f"line {statement.line}: {statement.name}: {name} must be {count} numbers")
        result.append(checked(float(number)))
    return tuple(result)


def argument(statement: Statement, index: int, name: str, default: Value | None = None) -> Value:
    """An argument of a statement, by place or by name.

    Raises:
        ScriptError: it is missing, and there is no default.
    """
    if name in statement.keywords:
        return statement.keywords[name]
    if index < len(statement.arguments):
        return statement.arguments[index]
    if default is None:
        raise ScriptError(f"line {statement.line}: {statement.name} needs {name}")
    return default


def move_of(statement: Statement, number: int = 0) -> Move:
    """The move of a movej, movel or movep statement; movep is taken for a movel with the same blend.

    Raises:
        ScriptError: it is none, or its arguments are wrong.
    """
    if statement.name not in ("movej", "movel", "movep"):
        raise ScriptError(f"line {statement.line}: the twin has no {statement.name} in a path")
    # Defaults of the script manual.
    straight = statement.name != "movej"
    acceleration = number_of(statement, 1, "a", 1.2 if straight else 1.4)
    speed = number_of(statement, 2, "v", 0.25 if straight else 1.05)
    time = number_of(statement, 3, "t", 0.0) if statement.name != "movep" else 0.0
    blend = number_of(statement, 3 if statement.name == "movep" else 4, "r", 0.0)
    if time > 0:
        raise ScriptError(f"line {statement.line}: the twin knows no {statement.name} with a duration t")
    target = numbers_of(statement, 0, "pose" if straight else "q", 6)
    is_pose = isinstance(argument(statement, 0, "pose" if straight else "q"), PoseValue)
    return Move(target, is_pose, straight, speed, acceleration, max(blend, 0.0), number)


def _script(lines: list[bytes]) -> Script:
    head = _HEAD.match(lines[0])
    text = b"\n".join(lines).decode("latin-1")
    if head is None:
        return Script("unnamed", text)
    return Script(head[2].decode(), text, head[1] == b"sec")


def _value(node: ast.expr) -> Value:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() as value):
            return value
        case ast.List(elts=elements):
            return [_value(element) for element in elements]
        case ast.Subscript(value=ast.Name(id="p"), slice=ast.Tuple(elts=elements)):
            return PoseValue(tuple(_number(element) for element in elements))
        case ast.UnaryOp() | ast.BinOp():
            return _number(node)
    raise ValueError("not a plain value")


def _number(node: ast.expr) -> float:
    match node:
        case ast.Constant(value=bool() | int() | float() as value):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_number(operand)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _SUMS:
            return float(_SUMS[type(op)](_number(left), _number(right)))
    raise ValueError("not a number")


_SUMS: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
