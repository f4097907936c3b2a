"""What a client writes by RTDE: where each input variable goes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sim_twin.wire.ur.controller import Controller
    from sim_twin.wire.ur.variables import Value


def write_inputs(controller: Controller, values: Iterable[tuple[str, Value]]) -> None:
    """Take over the input variables of one data package."""
    settings: dict[str, float] = {}
    for name, value in values:
        if name.startswith("input_"):
            _write_register(controller, name, value)
        elif isinstance(value, (bool, int, float)):
            settings[name] = value
    if settings:
        _set(controller, settings)


def _write_register(controller: Controller, name: str, value: Value) -> None:
    registers = controller.registers
    kind, _, number = name.removeprefix("input_").rpartition("_")
    if kind == "int_register":
        registers.input_int[int(number)] = value  # type: ignore[assignment]
    elif kind == "double_register":
        registers.input_double[int(number)] = value  # type: ignore[assignment]
    elif kind == "bit_register":
        registers.input_bit[int(number)] = bool(value)
    else:
        first = 0 if name == "input_bit_registers0_to_31" else 32
        registers.input_bit[first : first + 32] = [bool(int(value) >> i & 1) for i in range(32)]  # type: ignore[arg-type]


def _set(controller: Controller, settings: dict[str, float]) -> None:
    outputs = controller.outputs
    for group, first in (("standard", 0), ("configurable", 8), ("tool", 16)):
        mask = int(settings.get(f"{group}_digital_output_mask", 0)) << first
        bits = int(settings.get(f"{group}_digital_output", 0)) << first
        outputs.digital = outputs.digital & ~mask | bits & mask
    analog_mask = int(settings.get("standard_analog_output_mask", 0))
    for i in (0, 1):
        share = settings.get(f"standard_analog_output_{i}", math.nan)
        if analog_mask >> i & 1 and math.isfinite(share):
            outputs.analog[i] = min(max(share, 0.0), 1.0)
            types = int(settings.get("standard_analog_output_type", 0))
            outputs.analog_types = outputs.analog_types & ~(1 << i) | types & 1 << i
    fraction = settings.get("speed_slider_fraction", math.nan)
    if settings.get("speed_slider_mask") and math.isfinite(fraction):
        controller.slider = min(max(fraction, 0.0), 1.0)
