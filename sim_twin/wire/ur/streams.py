"""What the primary, secondary and realtime ports send without being asked.

Layouts: Universal Robots, "Client interfaces" for software 5.10 (robot state every 100 ms) and "RealTime 5.10" (1220
bytes). Fields that are for UR's own software are zero.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from robotcell.geometry import ur5e
from sim_twin.wire.ur.controller import VERSION
from sim_twin.wire.ur.modes import RobotMode, RuntimeState, SafetyMode
from sim_twin.wire.ur.reports import ErrorCode, ProgramEvent, RuntimeException, SafetyChange, Text
from sim_twin.wire.ur.snapshot import joint_mode

if TYPE_CHECKING:
    from sim_twin.wire.ur.controller import Controller
    from sim_twin.wire.ur.reports import Report
    from sim_twin.wire.ur.snapshot import Snapshot

STATE_PERIOD_S = 0.1

_ROBOT_STATE, _ROBOT_MESSAGE = 16, 20
_TEXT_MESSAGE, _VERSION_MESSAGE, _SAFETY_MODE_MESSAGE, _ERROR_CODE_MESSAGE = 0, 3, 5, 6
_KEY_MESSAGE, _RUNTIME_EXCEPTION_MESSAGE = 7, 10
# Report level of an error code; the twin knows no columns.
_VIOLATION = 3
_FIRST_COLUMN = 1
_LONGEST_TEXT = 1000
# "Linearised": UR's client library takes no other status for a calibrated arm.
_CALIBRATED = 2
_NO_TIMESTAMP = 2**64 - 1
# controlMode POSITION; masterboard types of an e-Series UR5.
_POSITION_CONTROL = 0
_ROBOT_TYPE_UR5, _E_SERIES = 1, 1


def version_message() -> bytes:
    """The first message on a primary or secondary connection."""
    name = b"URControl"
    major, minor, bugfix, build = VERSION
    body = (
        struct.pack(">B", len(name))
        + name
        + struct.pack(">BBii", major, minor, bugfix, build)
        + b"22-03-2022, 00:00:00"
    )
    return _robot_message(_NO_TIMESTAMP, _VERSION_MESSAGE, body)


def report_message(time_s: float, report: Report) -> bytes:
    """What happened, for primary clients."""
    kind, body = _body(report)
    return _robot_message(round(time_s * 1e6), kind, body)


def _body(report: Report) -> tuple[int, bytes]:
    match report:
        case Text(text):
            return _TEXT_MESSAGE, _latin(text)
        case ProgramEvent(name, started):
            title = b"PROGRAM_XXX_STARTED" if started else b"PROGRAM_XXX_STOPPED"
            return _KEY_MESSAGE, struct.pack(">iiB", 0, 0, len(title)) + title + _latin(name)
        case RuntimeException(line, text):
            return _RUNTIME_EXCEPTION_MESSAGE, struct.pack(">ii", line, _FIRST_COLUMN) + _latin(text)
        case ErrorCode(code, argument, text):
            return _ERROR_CODE_MESSAGE, struct.pack(">iiiII", code, argument, _VIOLATION, 0, 0) + _latin(text)
        case SafetyChange(mode, cause):
            code, argument = (cause.code, cause.argument) if cause is not None else (0, 0)
            return _SAFETY_MODE_MESSAGE, struct.pack(">iiBII", code, argument, mode, 0, 0)


def _latin(text: str) -> bytes:
    return text.encode("latin-1", "replace")[:_LONGEST_TEXT]


def robot_state(controller: Controller, values: Snapshot) -> bytes:
    """The robot state message."""
    parts = (
        _part(0, _mode_data(controller)),
        _part(1, _joint_data(controller, values)),
        _part(4, struct.pack(">12d", *_six(values, "actual_TCP_pose"), *controller.arm.tcp)),
        _part(5, _kinematics_data()),
        _part(3, _masterboard_data(controller)),
        _part(2, struct.pack(">BBddfBffB", 0, 0, 0.0, 0.0, 48.0, 0, 0.0, 30.0, 253)),
        _part(6, _configuration_data()),
        _part(7, struct.pack(">7d", *_six(values, "actual_TCP_force"), 0.0)),
        _part(8, struct.pack(">4B", controller.arm.freedrive, controller.arm.freedrive, 0, 0)),
        _part(11, struct.pack(">?iiiff", False, 115200, 0, 1, 1.5, 3.5)),
        _part(12, struct.pack(">BBB", 0, 0, 0)),
        _part(13, struct.pack(">BB", 0, 0)),
    )
    body = b"".join(parts)
    return struct.pack(">iB", 5 + len(body), _ROBOT_STATE) + body


def realtime_packet(values: Snapshot) -> bytes:
    """The packet of the realtime port."""
    numbers: list[float] = []
    for name in _REALTIME:
        value = 0.0 if name == "" else values[name]
        numbers += [value] if isinstance(value, (bool, int, float)) else value
    return struct.pack(f">i{len(numbers)}d", 4 + 8 * len(numbers), *numbers)


# "" stands for a number that only UR's own software uses.
_REALTIME = (
    "timestamp",
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_control_output",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_TCP_pose",
    "target_TCP_speed",
    "actual_digital_input_bits",
    "joint_temperatures",
    "actual_execution_time",
    "",
    "robot_mode",
    "joint_mode",
    "safety_mode",
    *[""] * 6,
    "actual_tool_accelerometer",
    *[""] * 6,
    "speed_scaling",
    "actual_momentum",
    *[""] * 2,
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "actual_joint_voltage",
    "actual_digital_output_bits",
    "runtime_state",
    "elbow_position",
    "elbow_velocity",
    "safety_status",
    *[""] * 3,
    "payload",
    "payload_cog",
    "payload_inertia",
)


def _mode_data(controller: Controller) -> bytes:
    mode = controller.robot_mode
    return struct.pack(
        ">Q7?BBdddB",
        round(controller.time * 1e6),
        mode is not RobotMode.BOOTING,
        mode is not RobotMode.BOOTING,
        RobotMode.POWER_ON <= mode <= RobotMode.RUNNING,
        controller.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP,
        controller.safety_mode is SafetyMode.PROTECTIVE_STOP,
        controller.runtime in (RuntimeState.PLAYING, RuntimeState.PAUSING),
        controller.runtime is RuntimeState.PAUSED,
        mode,
        _POSITION_CONTROL,
        controller.speed_fraction,
        controller.arm.rate,
        1.0,
        0,
    )


def _joint_data(controller: Controller, values: Snapshot) -> bytes:
    mode = joint_mode(controller)
    joints = zip(_six(values, "actual_q"), _six(values, "target_q"), _six(values, "actual_qd"), strict=True)
    return b"".join(struct.pack(">3d4fB", q, target, qd, 0.0, 48.0, 30.0, 30.0, mode) for q, target, qd in joints)


def _masterboard_data(controller: Controller) -> bytes:
    outputs = controller.outputs
    return struct.pack(
        ">iiBBddbbddffffBBbIBBB",
        0,
        outputs.digital,
        0,
        0,
        0.0,
        0.0,
        outputs.analog_types & 1,
        outputs.analog_types >> 1 & 1,
        *outputs.analog,
        30.0,
        48.0,
        0.5,
        0.0,
        controller.safety_mode,
        0,
        0,
        0,
        0,
        0,
        0,
    )


def _kinematics_data() -> bytes:
    """Nominal Denavit-Hartenberg values, which are exact for this arm: it counts as calibrated. No checksums."""
    theta = (0.0,) * 6
    numbers = (*theta, *ur5e.DH_A, *ur5e.DH_D, *ur5e.DH_ALPHA)
    return struct.pack(">6I24dI", *(0,) * 6, *numbers, _CALIBRATED)


def _configuration_data() -> bytes:
    limits = [bound for limit in ur5e.JOINT_LIMIT for bound in (-limit, limit)]
    speeds = [bound for _ in range(6) for bound in (ur5e.MAX_JOINT_SPEED, ur5e.MAX_JOINT_ACCELERATION)]
    defaults = (1.05, 1.4, 0.25, 1.2, 0.1)
    dh = (*ur5e.DH_A, *ur5e.DH_D, *ur5e.DH_ALPHA, *(0.0,) * 6)
    return struct.pack(">12d12d5d24d4i", *limits, *speeds, *defaults, *dh, 0, 0, _ROBOT_TYPE_UR5, _E_SERIES)


def _six(values: Snapshot, name: str) -> tuple[float, ...]:
    value = values[name]
    assert not isinstance(value, (bool, int, float))
    return tuple(value)


def _part(kind: int, body: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(body), kind) + body


def _robot_message(timestamp: int, kind: int, body: bytes) -> bytes:
    source = 0xFD  # -3, as the controller sends it for messages of URControl itself
    head = struct.pack(">QBB", timestamp, source, kind)
    return struct.pack(">iB", 5 + len(head) + len(body), _ROBOT_MESSAGE) + head + body
