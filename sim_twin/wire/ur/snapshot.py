"""What the controller reports of itself: a value for every RTDE variable.

Known to the twin: time, joints, tcp, contact wrench, modes, program, registers, outputs, payload. What no part of it
models stands at a constant that a resting UR5e would show, see `_CONSTANTS`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from robotcell.geometry import ur5e
from sim_twin.wire.ur.modes import RobotMode, RuntimeState, SafetyMode
from sim_twin.wire.ur.variables import OUTPUTS, REGISTERS, SINGLE_BITS, Value

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.geometry.transforms import Array
    from sim_twin.wire.ur.controller import Controller

_SIX = (0.0,) * 6
_THREE = (0.0,) * 3
_JOINT_RUNNING, _JOINT_IDLE, _JOINT_POWER_OFF = 253, 255, 239
_TOOL_RUNNING = 253
_SHOULDER, _UPPER_ARM = float(ur5e.DH_D[0]), float(ur5e.DH_A[1])

# Currents and torques are not modelled; temperatures and voltages are those of an arm at rest.
_CONSTANTS: dict[str, Value] = {
    "target_current": _SIX,
    "target_moment": _SIX,
    "actual_current": _SIX,
    "actual_current_window": _SIX,
    "actual_current_as_torque": _SIX,
    "joint_control_output": _SIX,
    "actual_TCP_acceleration": _SIX,
    "target_TCP_acceleration": _SIX,
    "actual_digital_input_bits": 0,
    "actual_configurable_digital_input_bits": 0,
    "joint_temperatures": (30.0,) * 6,
    "target_execution_time": 0.0,
    "actual_tool_accelerometer": _THREE,
    "actual_momentum": 0.0,
    "actual_main_voltage": 48.0,
    "actual_robot_voltage": 48.0,
    "actual_robot_current": 0.5,
    "actual_joint_voltage": (48.0,) * 6,
    "standard_analog_input0": 0.0,
    "standard_analog_input1": 0.0,
    "io_current": 0.0,
    "actual_robot_energy_consumed": 0.0,
    "actual_robot_braking_energy_dissipated": 0.0,
    "encoder0_raw": 0,
    "encoder1_raw": 0,
    "euromap67_input_bits": 0,
    "euromap67_output_bits": 0,
    "euromap67_24V_voltage": 0.0,
    "euromap67_24V_current": 0.0,
    "tool_mode": _TOOL_RUNNING,
    "tool_analog_input_types": 0,
    "tool_analog_input0": 0.0,
    "tool_analog_input1": 0.0,
    "tool_output_voltage": 0,
    "tool_output_current": 0.0,
    "tool_temperature": 30.0,
    "tool_output_mode": 0,
    "tool_digital_output0_mode": 0,
    "tool_digital_output1_mode": 0,
    "joint_position_deviation_ratio": 0.0,
    "collision_detection_ratio": 0.0,
    "script_control_line": 0,
    "time_scale_source": 0,
    "target_base_acceleration": _SIX,
    "target_base_wrench": _SIX,
}


class Snapshot(dict[str, Value]):
    """The values of one control period, each worked out when it is first asked for.

    Args:
        controller: whose values they are; it must not tick as long as this is read.
    """

    def __init__(self, controller: Controller) -> None:
        super().__init__(_CONSTANTS)
        self._controller = controller

    def __missing__(self, name: str) -> Value:
        value = _SOURCES[name](self._controller)
        self[name] = value
        return value


def safety_status_bits(controller: Controller) -> int:
    """safety_status_bits of RTDE."""
    bits = {
        SafetyMode.NORMAL: 1 << 0,
        SafetyMode.PROTECTIVE_STOP: 1 << 2,
        SafetyMode.SAFEGUARD_STOP: 1 << 4,
        SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7,
        SafetyMode.VIOLATION: 1 << 8,
    }[controller.safety_mode]
    return bits if controller.safe else bits | 1 << 10


def joint_mode(controller: Controller) -> int:
    """joint_mode of RTDE, the same for all joints."""
    if controller.powered:
        return _JOINT_RUNNING
    return _JOINT_IDLE if controller.robot_mode is RobotMode.IDLE else _JOINT_POWER_OFF


def _robot_status_bits(controller: Controller) -> int:
    powered = RobotMode.POWER_ON <= controller.robot_mode <= RobotMode.RUNNING
    running = controller.runtime in (RuntimeState.PLAYING, RuntimeState.PAUSING, RuntimeState.RESUMING)
    # Bit 3, the power button, is let go.
    return powered << 0 | running << 1 | controller.arm.freedrive << 2


def _list(vector: Array) -> list[float]:
    numbers: list[float] = vector.tolist()
    return numbers


def _tcp_speed(controller: Controller, q: Array, qd: Array) -> list[float]:
    return _list(controller.arm.twist(q, qd))


def _elbow(controller: Controller) -> list[float]:
    """The origin of the second Denavit-Hartenberg frame."""
    base, shoulder = controller.arm.measured_q[:2].tolist()
    reach = _UPPER_ARM * math.cos(shoulder)
    return [reach * math.cos(base), reach * math.sin(base), _SHOULDER + _UPPER_ARM * math.sin(shoulder)]


def _elbow_speed(controller: Controller) -> list[float]:
    base, shoulder = controller.arm.measured_q[:2].tolist()
    base_speed, shoulder_speed = controller.arm.measured_qd[:2].tolist()
    out = -_UPPER_ARM * math.sin(shoulder) * shoulder_speed
    around = _UPPER_ARM * math.cos(shoulder) * base_speed
    c, s = math.cos(base), math.sin(base)
    return [c * out - s * around, s * out + c * around, _UPPER_ARM * math.cos(shoulder) * shoulder_speed]


def _raw_wrench(controller: Controller) -> list[float]:
    """As the sensor has it: axes of the flange, nothing subtracted."""
    arm = controller.arm
    R = arm.flange(arm.measured_q)[:3, :3]
    return _list(R.T @ arm.wrench[:3]) + _list(R.T @ arm.wrench[3:])


_SOURCES: dict[str, Callable[[Controller], Value]] = {
    "timestamp": lambda c: c.time,
    "actual_execution_time": lambda c: c.execution_time,
    "control_step": lambda c: c.ticks,
    "target_q": lambda c: c.arm.q.tolist(),
    "target_qd": lambda c: c.arm.qd.tolist(),
    "target_qdd": lambda c: c.arm.qdd.tolist(),
    "actual_q": lambda c: c.arm.measured_q.tolist(),
    "actual_qd": lambda c: c.arm.measured_qd.tolist(),
    "actual_TCP_pose": lambda c: c.arm.tcp_pose(c.arm.measured_q),
    "actual_TCP_speed": lambda c: _tcp_speed(c, c.arm.measured_q, c.arm.measured_qd),
    "actual_TCP_force": lambda c: c.arm.tcp_wrench.tolist(),
    "target_TCP_pose": lambda c: c.arm.tcp_pose(c.arm.q),
    "target_TCP_speed": lambda c: _tcp_speed(c, c.arm.q, c.arm.qd),
    "tcp_offset": lambda c: c.arm.tcp,
    "robot_mode": lambda c: int(c.robot_mode),
    "joint_mode": lambda c: (joint_mode(c),) * 6,
    "safety_mode": lambda c: int(c.safety_mode),
    # Its numbers are those of safety_mode for all that the twin knows.
    "safety_status": lambda c: int(c.safety_mode),
    "speed_scaling": lambda c: c.arm.rate,
    "target_speed_fraction": lambda c: c.speed_fraction,
    "actual_digital_output_bits": lambda c: c.outputs.digital,
    "actual_configurable_digital_output_bits": lambda c: c.outputs.digital >> 8 & 0xFF,
    "runtime_state": lambda c: int(c.runtime),
    "elbow_position": _elbow,
    "elbow_velocity": _elbow_speed,
    "robot_status_bits": _robot_status_bits,
    "safety_status_bits": safety_status_bits,
    # Bits 0 and 1 are the inputs, 2 and 3 the outputs.
    "analog_io_types": lambda c: c.outputs.analog_types << 2,
    "standard_analog_output0": lambda c: _analog(c, 0),
    "standard_analog_output1": lambda c: _analog(c, 1),
    "tcp_force_scalar": lambda c: math.hypot(*c.arm.tcp_wrench[:3].tolist()),
    "ft_raw_wrench": _raw_wrench,
    "wrench_calc_from_currents": lambda c: c.arm.tcp_wrench.tolist(),
    "payload": lambda c: c.payload.mass,
    "payload_cog": lambda c: c.payload.cog,
    "payload_inertia": lambda c: c.payload.inertia,
    "target_gravity": lambda c: c.gravity,
}


def _analog(controller: Controller, number: int) -> float:
    """[A] or [V], by the type of the output."""
    share = controller.outputs.analog[number]
    return 10.0 * share if controller.outputs.analog_types >> number & 1 else 0.004 + 0.016 * share


def _packed(bits: list[bool]) -> int:
    return sum(bit << i for i, bit in enumerate(bits))


def _add_registers() -> None:
    for side in ("input", "output"):

        def source(kind: str, i: int, side: str = side) -> Callable[[Controller], Value]:
            name = f"{side}_{kind}"
            return lambda c: getattr(c.registers, name)[i]

        def word(first: int, side: str = side) -> Callable[[Controller], Value]:
            return lambda c: _packed(getattr(c.registers, f"{side}_bit")[first : first + 32])

        _SOURCES[f"{side}_bit_registers0_to_31"] = word(0)
        _SOURCES[f"{side}_bit_registers32_to_63"] = word(32)
        _SOURCES.update({f"{side}_bit_register_{i}": source("bit", i) for i in SINGLE_BITS})
        _SOURCES.update({f"{side}_int_register_{i}": source("int", i) for i in range(REGISTERS)})
        _SOURCES.update({f"{side}_double_register_{i}": source("double", i) for i in range(REGISTERS)})


_add_registers()
assert OUTPUTS.keys() == _SOURCES.keys() | _CONSTANTS.keys()
