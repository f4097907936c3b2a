"""URScript statements as far as the twin reads them: one call a line, with numbers, lists and poses as arguments."""

from __future__ import annotations

import ast
import operator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from sim_twin.wire.ur.moves import SLOWEST, Move
from sim_twin.wire.ur.program import ScriptError, checked

if TYPE_CHECKING:
    from collections.abc import Callable

# So much of a line is quoted to the clients.
_SHOWN = 200

Value: TypeAlias = "float | int | bool | str | PoseValue | list[Value]"


@dataclass(frozen=True)
class PoseValue:
    """p[x, y, z, rx, ry, rz]."""

    numbers: tuple[float, ...]


@dataclass(frozen=True)
class Statement:
    """One call, or the keyword halt: its line in the program, the name, and the arguments."""

    line: int
    name: str
    arguments: tuple[Value, ...] = ()
    keywords: dict[str, Value] = field(default_factory=dict)

    def refused(self, why: str) -> ScriptError:
        """The error that says why this statement cannot be carried out."""
        return ScriptError(f"{self.name}: {why}", self.line)


def parse_statement(code: str, line: int) -> Statement:
    """One line without its comment.

    Raises:
        ScriptError: it is neither halt nor a call with plain arguments.
    """
    code = code.strip()
    if code == "halt":
        return Statement(line, code)
    try:
        call = ast.parse(code, mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            raise ValueError("no call")
        arguments = tuple(_value(node) for node in call.args)
        keywords = {str(word.arg): _value(word.value) for word in call.keywords}
    except (SyntaxError, ValueError, RecursionError, MemoryError, ZeroDivisionError, OverflowError):
        raise not_understood(code, line) from None
    return Statement(line, call.func.id, arguments, keywords)


def not_understood(code: str, line: int) -> ScriptError:
    """The error of a line that is no statement that the twin knows; as the controller says it of a syntax error."""
    return ScriptError(
        f"the twin does not understand {code[:60]!r}", line, f"syntax_error_on_line:{line}:{code[:_SHOWN]}:"
    )


def number_of(statement: Statement, index: int, name: str, default: float | None = None) -> float:
    """A number among the arguments of a statement, by place or by name.

    Raises:
        ScriptError: it is missing or no number.
    """
    value = argument(statement, index, name, default)
    if isinstance(value, (bool, int, float)):
        return checked(float(value))
    raise statement.refused(f"{name} must be a number")


def numbers_of(statement: Statement, index: int, name: str, count: int) -> tuple[float, ...]:
    """A list or pose of numbers among the arguments of a statement.

    Raises:
        ScriptError: it is missing or something else.
    """
    value = argument(statement, index, name)
    numbers = value.numbers if isinstance(value, PoseValue) else value
    if not isinstance(numbers, (list, tuple)) or len(numbers) != count:
        raise statement.refused(f"{name} must be {count} numbers")
    result = []
    for number in numbers:
        if not isinstance(number, (int, float)):
            raise statement.refused(f"{name} must be {count} numbers")
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
        raise statement.refused(f"needs {name}")
    return default


def move_of(statement: Statement, number: int = 0) -> Move:
    """The move of a movej, movel or movep statement; movep is taken for a movel with the same blend.

    Raises:
        ScriptError: it is none, or its arguments are wrong.
    """
    if statement.name not in ("movej", "movel", "movep"):
        raise statement.refused("the twin has no such move in a path")
    # Defaults of the script manual.
    straight = statement.name != "movej"
    acceleration = number_of(statement, 1, "a", 1.2 if straight else 1.4)
    speed = number_of(statement, 2, "v", 0.25 if straight else 1.05)
    time = number_of(statement, 3, "t", 0.0) if statement.name != "movep" else 0.0
    blend = number_of(statement, 3 if statement.name == "movep" else 4, "r", 0.0)
    if time > 0:
        raise statement.refused("the twin knows no move with a duration t")
    if not (speed >= SLOWEST and acceleration >= SLOWEST):
        raise statement.refused(f"speed and acceleration must be at least {SLOWEST:g}")
    target = numbers_of(statement, 0, "pose" if straight else "q", 6)
    is_pose = isinstance(argument(statement, 0, "pose" if straight else "q"), PoseValue)
    return Move(target, is_pose, straight, speed, acceleration, max(blend, 0.0), number, statement.line)


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
