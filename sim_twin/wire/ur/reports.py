"""What the controller tells the clients that read its messages. The streams give them their layout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from sim_twin.wire.ur.modes import SafetyMode


@dataclass(frozen=True)
class Text:
    """Something happened."""

    text: str


@dataclass(frozen=True)
class ProgramEvent:
    """A program has started, or has stopped."""

    name: str
    started: bool


@dataclass(frozen=True)
class RuntimeException:
    """A program was refused, or has died.

    Attributes:
        line: of the program, from 1; 0 where no line is to blame.
        text: in the controller's words.
    """

    line: int
    text: str


@dataclass(frozen=True)
class ErrorCode:
    """A fault with a number, as C153A2 of the service manual."""

    code: int
    argument: int
    text: str


@dataclass(frozen=True)
class SafetyChange:
    """Another safety mode."""

    mode: SafetyMode
    cause: ErrorCode | None


Report: TypeAlias = "Text | ProgramEvent | RuntimeException | ErrorCode | SafetyChange"
