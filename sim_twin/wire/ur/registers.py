"""What clients and programs set at the controller: general purpose registers, outputs and the payload."""

from __future__ import annotations

from dataclasses import dataclass, field

from sim_twin.wire.ur.variables import BIT_REGISTERS, REGISTERS


@dataclass
class Registers:
    """The general purpose registers."""

    input_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    input_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    input_bit: list[bool] = field(default_factory=lambda: [False] * BIT_REGISTERS)
    output_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    output_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    output_bit: list[bool] = field(default_factory=lambda: [False] * BIT_REGISTERS)


@dataclass
class Payload:
    """What the arm carries: mass [kg], centre of gravity in the flange [m], inertia [kg m^2]."""

    mass: float = 0.0
    cog: tuple[float, ...] = (0.0, 0.0, 0.0)
    inertia: tuple[float, ...] = (0.0,) * 6


@dataclass
class Outputs:
    """What the control box puts out: digital lines (standard 0-7, configurable 8-15, tool 16-17) and two analog ones.

    Analog values are shares of the range: 4-20 mA or, where the bit in `analog_types` is set, 0-10 V.
    """

    digital: int = 0
    analog: list[float] = field(default_factory=lambda: [0.0, 0.0])
    analog_types: int = 0
