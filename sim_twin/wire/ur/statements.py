"""What the statements of a plain URScript program do."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.moves import Move, follow
from sim_twin.wire.ur.program import ScriptError
from sim_twin.wire.ur.registers import Payload
from sim_twin.wire.ur.script import PoseValue, Statement, Value, argument, move_of, number_of, numbers_of
from sim_twin.wire.ur.speed_servo import servo_joints, speed_joints, speed_line
from sim_twin.wire.ur.stops import stop_joints, stop_line
from sim_twin.wire.ur.variables import BIT_REGISTERS, REGISTERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from sim_twin.wire.ur.controller import Controller
    from sim_twin.wire.ur.program import Thread

_Action: TypeAlias = "Callable[[Controller, Statement], Thread | None]"

_MOVES = frozenset({"movej", "movel", "movep"})
# So many statements that take no time are done in a period: a long row of them must not hold it up.
AT_ONCE = 20


def check_statement(statement: Statement) -> None:
    """See that the twin knows a statement, before anything of its program runs.

    Raises:
        ScriptError: it does not.
    """
    if statement.name in _MOVES:
        move_of(statement)
    elif statement.name != "halt" and statement.name not in _ACTIONS:
        raise ScriptError(
            f"the twin does not know {statement.name[:60]}",
            statement.line,
            f"compile_error_name_not_found:{statement.name[:60]}:",
        )


def run_statements(controller: Controller, statements: Iterable[Statement]) -> Thread:
    """A thread that carries out statements one after another. Moves that follow each other blend.

    Args:
        controller: that carries them out.
        statements: that `check_statement` has found right. Each is taken when its turn comes, or a move before it.

    Raises:
        ScriptError: a statement is not possible; it says which.
    """
    ahead = _Ahead(statements)
    at_once = 0
    while (statement := ahead.take()) is not None:
        if statement.name == "halt":
            return
        if statement.name in _MOVES:
            yield from follow(controller.arm, ahead.moves(statement))
            at_once = 0
            continue
        motion = _ACTIONS[statement.name](controller, statement)
        if motion is not None:
            yield from motion
            at_once = 0
            continue
        at_once += 1
        if at_once % AT_ONCE == 0:
            yield


def run_at_once(controller: Controller, statements: Iterable[Statement]) -> None:
    """Carry out a secondary program: nothing in it may take time.

    Raises:
        ScriptError: a statement is not possible, or a motion.
    """
    for _ in run_statements(controller, statements):
        raise ScriptError("a secondary program must not move the arm or wait")


class _Ahead:
    """Statements in their order, with a look at the next one."""

    def __init__(self, statements: Iterable[Statement]) -> None:
        self._rest = iter(statements)
        self._next = next(self._rest, None)

    def take(self) -> Statement | None:
        """The next statement, None at the end."""
        taken, self._next = self._next, next(self._rest, None)
        return taken

    def moves(self, first: Statement) -> Iterator[Move]:
        """A move, and those that follow it directly."""
        yield move_of(first)
        while self._next is not None and self._next.name in _MOVES:
            yield move_of(self._next)
            self.take()


def _stop_joints(controller: Controller, statement: Statement) -> Thread:
    return stop_joints(controller.arm, number_of(statement, 0, "a", 2.0))


def _stop_line(controller: Controller, statement: Statement) -> Thread:
    return stop_line(controller.arm, number_of(statement, 0, "a", 20.0))


def _speed_joints(controller: Controller, statement: Statement) -> Thread:
    speed = np.array(numbers_of(statement, 0, "qd", 6))
    acceleration, time = number_of(statement, 1, "a", 1.4), number_of(statement, 2, "t", 0.0)
    return speed_joints(controller.arm, speed, acceleration, time)


def _speed_line(controller: Controller, statement: Statement) -> Thread:
    speed = np.array(numbers_of(statement, 0, "xd", 6))
    acceleration, time = number_of(statement, 1, "a", 1.2), number_of(statement, 2, "t", 0.0)
    return speed_line(controller.arm, speed, acceleration, time)


def _servo_joints(controller: Controller, statement: Statement) -> Thread:
    q = np.array(numbers_of(statement, 0, "q", 6))
    time = number_of(statement, 3, "t", PERIOD_S)
    lookahead, gain = number_of(statement, 4, "lookahead_time", 0.1), number_of(statement, 5, "gain", 300.0)
    return servo_joints(controller.arm, q, time, lookahead, gain)


def _sleep(controller: Controller, statement: Statement) -> Thread:
    until = controller.time + number_of(statement, 0, "t")
    while controller.time < until:
        yield


def _sync(_: Controller, __: Statement) -> Thread:
    yield


def _set_tcp(controller: Controller, statement: Statement) -> None:
    controller.set_tcp(numbers_of(statement, 0, "pose", 6))


def _set_payload(controller: Controller, statement: Statement) -> None:
    mass = number_of(statement, 0, "m")
    if mass < 0:
        raise statement.refused("the mass must not be negative")
    old = controller.payload
    given = len(statement.arguments) > 1 or "cog" in statement.keywords
    cog = numbers_of(statement, 1, "cog", 3) if given else old.cog
    controller.set_payload(Payload(mass, cog, old.inertia))


def _text(controller: Controller, statement: Statement) -> None:
    controller.note("textmsg", "".join(_shown(argument) for argument in statement.arguments))


def _popup(controller: Controller, statement: Statement) -> None:
    controller.popup = _shown(argument(statement, 0, "s"))


def _digital(first: int, count: int) -> _Action:
    def act(controller: Controller, statement: Statement) -> None:
        number = _index(statement, count)
        bit = 1 << first + number
        on = bool(number_of(statement, 1, "b"))
        outputs = controller.outputs
        outputs.digital = outputs.digital | bit if on else outputs.digital & ~bit

    return act


def _analog(controller: Controller, statement: Statement) -> None:
    share = number_of(statement, 1, "f")
    controller.outputs.analog[_index(statement, 2)] = min(max(share, 0.0), 1.0)


def _write_int(controller: Controller, statement: Statement) -> None:
    value = number_of(statement, 1, "value")
    if not -(2**31) <= value < 2**31:
        raise statement.refused(f"{value:g} does not fit an integer register")
    controller.registers.output_int[_index(statement, REGISTERS)] = int(value)


def _write_float(controller: Controller, statement: Statement) -> None:
    controller.registers.output_double[_index(statement, REGISTERS)] = number_of(statement, 1, "value")


def _write_bit(controller: Controller, statement: Statement) -> None:
    controller.registers.output_bit[_index(statement, BIT_REGISTERS)] = bool(number_of(statement, 1, "value"))


def _zero(controller: Controller, _: Statement) -> None:
    controller.arm.zero_wrench()


def _protect(controller: Controller, _: Statement) -> None:
    controller.protective_stop("the program asked for it")


def _free(on: bool) -> _Action:
    def act(controller: Controller, _: Statement) -> None:
        controller.arm.freedrive = on

    return act


def _index(statement: Statement, count: int) -> int:
    number = number_of(statement, 0, "n")
    if not 0 <= number < count or number != int(number):
        raise statement.refused(f"there are only {count}, from 0")
    return int(number)


def _shown(value: Value) -> str:
    if isinstance(value, PoseValue):
        return f"p{list(value.numbers)}"
    return str(value)


_ACTIONS: dict[str, _Action] = {
    "stopj": _stop_joints,
    "stopl": _stop_line,
    "speedj": _speed_joints,
    "speedl": _speed_line,
    "servoj": _servo_joints,
    "sleep": _sleep,
    "sync": _sync,
    "set_tcp": _set_tcp,
    "set_payload": _set_payload,
    "set_target_payload": _set_payload,
    "textmsg": _text,
    "popup": _popup,
    "set_digital_out": _digital(0, 18),
    "set_standard_digital_out": _digital(0, 8),
    "set_configurable_digital_out": _digital(8, 8),
    "set_tool_digital_out": _digital(16, 2),
    "set_analog_out": _analog,
    "set_standard_analog_out": _analog,
    "write_output_integer_register": _write_int,
    "write_output_float_register": _write_float,
    "write_output_boolean_register": _write_bit,
    "zero_ftsensor": _zero,
    "protective_stop": _protect,
    "freedrive_mode": _free(True),
    "end_freedrive_mode": _free(False),
    "teach_mode": _free(True),
    "end_teach_mode": _free(False),
}
