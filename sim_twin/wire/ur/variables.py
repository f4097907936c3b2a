"""Names and types of all RTDE variables, and their packing.

The table is that of Universal Robots' RTDE guide, checked against the one in UR's own client library. Variables that
are younger than the version that the twin reports are in it too: who knows the version does not ask for them.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

Value: TypeAlias = "bool | int | float | Sequence[int] | Sequence[float]"

# RTDE guide, "Field types": each type as `struct` letters, and how many numbers it holds.
_LETTERS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
_COUNTS = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR6UINT32": 6}

REGISTERS = 48
# The lower 64 bit registers are only there as two words of 32.
BIT_REGISTERS = 128
SINGLE_BITS = range(64, BIT_REGISTERS)


def _registers(side: str) -> dict[str, str]:
    return {
        f"{side}_bit_registers0_to_31": "UINT32",
        f"{side}_bit_registers32_to_63": "UINT32",
        **{f"{side}_bit_register_{i}": "BOOL" for i in SINGLE_BITS},
        **{f"{side}_int_register_{i}": "INT32" for i in range(REGISTERS)},
        **{f"{side}_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
    }


# What a client may write.
INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **_registers("input"),
}

# What a client may read.
OUTPUTS: dict[str, str] = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "target_qd": "VECTOR6D",
    "target_qdd": "VECTOR6D",
    "target_current": "VECTOR6D",
    "target_moment": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_current": "VECTOR6D",
    "actual_current_window": "VECTOR6D",
    "actual_current_as_torque": "VECTOR6D",
    "joint_control_output": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "target_TCP_pose": "VECTOR6D",
    "target_TCP_speed": "VECTOR6D",
    "tcp_offset": "VECTOR6D",
    "actual_TCP_acceleration": "VECTOR6D",
    "target_TCP_acceleration": "VECTOR6D",
    "actual_digital_input_bits": "UINT64",
    "actual_configurable_digital_input_bits": "UINT64",
    "joint_temperatures": "VECTOR6D",
    "actual_execution_time": "DOUBLE",
    "target_execution_time": "DOUBLE",
    "robot_mode": "INT32",
    "joint_mode": "VECTOR6INT32",
    "safety_mode": "INT32",
    "safety_status": "INT32",
    "actual_tool_accelerometer": "VECTOR3D",
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "actual_momentum": "DOUBLE",
    "actual_main_voltage": "DOUBLE",
    "actual_robot_voltage": "DOUBLE",
    "actual_robot_current": "DOUBLE",
    "actual_joint_voltage": "VECTOR6D",
    "actual_digital_output_bits": "UINT64",
    "actual_configurable_digital_output_bits": "UINT64",
    "runtime_state": "UINT32",
    "elbow_position": "VECTOR3D",
    "elbow_velocity": "VECTOR3D",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "analog_io_types": "UINT32",
    "standard_analog_input0": "DOUBLE",
    "standard_analog_input1": "DOUBLE",
    "standard_analog_output0": "DOUBLE",
    "standard_analog_output1": "DOUBLE",
    "io_current": "DOUBLE",
    "actual_robot_energy_consumed": "DOUBLE",
    "actual_robot_braking_energy_dissipated": "DOUBLE",
    "encoder0_raw": "INT32",
    "encoder1_raw": "INT32",
    "euromap67_input_bits": "UINT32",
    "euromap67_output_bits": "UINT32",
    "euromap67_24V_voltage": "DOUBLE",
    "euromap67_24V_current": "DOUBLE",
    "tool_mode": "UINT32",
    "tool_analog_input_types": "UINT32",
    "tool_analog_input0": "DOUBLE",
    "tool_analog_input1": "DOUBLE",
    "tool_output_voltage": "INT32",
    "tool_output_current": "DOUBLE",
    "tool_temperature": "DOUBLE",
    "tool_output_mode": "UINT8",
    "tool_digital_output0_mode": "UINT8",
    "tool_digital_output1_mode": "UINT8",
    "tcp_force_scalar": "DOUBLE",
    "joint_position_deviation_ratio": "DOUBLE",
    "collision_detection_ratio": "DOUBLE",
    "ft_raw_wrench": "VECTOR6D",
    "wrench_calc_from_currents": "VECTOR6D",
    "payload": "DOUBLE",
    "payload_cog": "VECTOR3D",
    "payload_inertia": "VECTOR6D",
    "script_control_line": "UINT32",
    "time_scale_source": "INT32",
    "target_gravity": "VECTOR3D",
    "target_base_acceleration": "VECTOR6D",
    "control_step": "UINT64",
    "target_base_wrench": "VECTOR6D",
    **_registers("output"),
    **_registers("input"),
}


class Recipe:
    """Variables in the order in which they travel.

    Args:
        names: of the variables.
        types: of the variables, as in the tables above.
    """

    def __init__(self, names: Sequence[str], types: Sequence[str]) -> None:
        self.names = tuple(names)
        self._struct = struct.Struct(">" + "".join(_LETTERS[kind] for kind in types))
        self._counts = tuple(_COUNTS.get(kind, 0) for kind in types)

    @property
    def size(self) -> int:
        """Bytes of one packed set of values."""
        return self._struct.size

    def pack(self, values: Iterable[Value]) -> bytes:
        """One value per variable as bytes."""
        numbers: list[float] = []
        for count, value in zip(self._counts, values, strict=True):
            if count:
                numbers.extend(value)  # type: ignore[arg-type]
            else:
                numbers.append(value)  # type: ignore[arg-type]
        return self._struct.pack(*numbers)

    def unpack(self, data: bytes) -> Iterator[tuple[str, Value]]:
        """The variables and their values; `data` has `size` bytes."""
        numbers = self._struct.unpack(data)
        at = 0
        for name, count in zip(self.names, self._counts, strict=True):
            if count:
                yield name, numbers[at : at + count]
                at += count
            else:
                yield name, numbers[at]
                at += 1


def split_names(text: bytes) -> tuple[str, ...]:
    """The names of a set-up request; ur_rtde ends its lists with a comma."""
    names = text.decode("latin-1").split(",")
    return tuple(names[:-1] if names[-1] == "" else names)
