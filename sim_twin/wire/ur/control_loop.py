"""The control script of ur_rtde 1.6, natively: commands come in input registers, answers go out in output registers.

The numbers of commands and registers, and what each command does, are those of the script that the client uploads.
Where the script has a quirk (a synchronous stopL brakes the joints, an asynchronous stopJ the tool), so has this.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.geometry import ur5e
from sim_twin.wire.shared_state import PERIOD_S
from sim_twin.wire.ur.control_registers import ControlRegisters
from sim_twin.wire.ur.controller import Watchdog
from sim_twin.wire.ur.force_mode import ForceMode, along_motion, towards_origin
from sim_twin.wire.ur.moves import Move, follow
from sim_twin.wire.ur.pose import ZERO_POSE, Pose, matrix_to_pose, pose_to_matrix
from sim_twin.wire.ur.program import Program, ScriptError, Thread
from sim_twin.wire.ur.registers import Payload
from sim_twin.wire.ur.speed_servo import servo_circular, servo_joints, speed_joints, speed_line
from sim_twin.wire.ur.stops import stop_joints, stop_line

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from robotcell.geometry.transforms import Array
    from sim_twin.wire.ur.controller import Controller

READY, DONE = 1, 2
_STOP_SCRIPT = 255
_CONTACT = 254
# These are carried out again in every period as long as they stand in the register.
_REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
# Types of task frames, of force_mode.
_POINT_FRAME, _MOTION_FRAME = 1, 3
_CONTACT_STOP_M_S2 = 3.0
_BACK_TO_CONTACT = (0.25, 1.2)


class ControlLoop:
    """One upload of the script.

    Args:
        controller: that runs it.
        offset: of the registers, 0 or 24.
        path: that was injected into it.
    """

    def __init__(self, controller: Controller, offset: int = 0, path: Sequence[Move] = ()) -> None:
        self._controller = controller
        self._arm = controller.arm
        self._offset = offset
        self._registers = ControlRegisters(controller.registers, offset)
        self._path = path
        self.program = Program("rtde_control", self._main())
        self._move: Thread | None = None
        self._stop: Thread | None = None
        self._speed: Thread | None = None
        self._servo: Thread | None = None
        self._servo_circular: Thread | None = None
        self._jog: Thread | None = None
        self._contact: Thread | None = None
        self._contact_steps = 0
        self._internal = 0
        self._async_stop_used = False
        self._speed_args = (False, np.zeros(6), 0.5, 0.5)
        self._servo_args = (np.zeros(6), PERIOD_S, 0.1, 300.0)
        self._circle_args = (ZERO_POSE, 0.25, 1.2)
        self._jog_args: tuple[Array, float] = (np.zeros(6), 0.5)
        self._gain = 0.5
        registers, arm = self._registers, self._arm
        self._commands: dict[int, Callable[[], Thread | None]] = {
            1: lambda: self._move_to(is_pose=False, straight=False),
            2: self._move_joints_to_pose,
            3: lambda: self._move_to(is_pose=True, straight=True),
            4: lambda: self._move_to(is_pose=False, straight=True),
            6: self._force_mode,
            7: self._stop_force_mode,
            8: arm.zero_wrench,
            9: lambda: self._speed_command(line=False),
            10: lambda: self._speed_command(line=True),
            11: lambda: self._servo_command(registers.six(0)),
            12: self._servo_circular_command,
            15: self._stop_speed,
            16: self._stop_servo,
            17: self._set_payload,
            18: lambda: self._free(on=True),
            19: lambda: self._free(on=False),
            20: lambda: None,
            21: self._set_gain,
            24: lambda: self._servo_command(arm.inverse(pose_to_matrix(registers.floats(0, 6)), arm.q)),
            25: lambda: registers.answer(self._controller.history.contact_steps(registers.floats(0, 3))),
            26: lambda: registers.answer_floats((PERIOD_S,)),
            27: lambda: registers.answer_floats(self._controller.history.joints_before(registers.integer(1)).tolist()),
            28: lambda: registers.answer_floats(arm.tcp_pose(arm.waypoint)),
            29: lambda: self._controller.set_tcp(registers.floats(0, 6)),
            30: lambda: self._inverse(registers.six(6)),
            31: lambda: self._controller.protective_stop("the program asked for it"),
            33: self._stop_command,
            34: self._stop_command,
            35: self._set_watchdog,
            36: lambda: registers.answer(self._reachable(arm.q)),
            37: lambda: registers.answer(bool((np.abs(registers.six(0)) <= ur5e.JOINT_LIMIT).all())),
            38: lambda: registers.answer_floats((0.0,) * 6),
            39: self._transform,
            40: lambda: registers.answer_floats(arm.tcp),
            41: self._start_jog,
            42: self._stop_jog,
            43: lambda: registers.answer_floats(arm.tcp_pose(arm.measured_q)),
            44: self._forward,
            45: self._follow_path,
            46: lambda: self._inverse(arm.q),
            47: lambda: registers.answer(arm.steady),
            51: self._move_until_contact,
            52: lambda: self._free(on=True),
            53: lambda: self._free(on=False),
            54: lambda: registers.answer(0),
            56: lambda: None,
            57: lambda: None,
            58: lambda: registers.answer_floats(self._flange_pose()),
            59: self._set_gravity,
            60: lambda: registers.answer(self._reachable(arm.q)),
            61: lambda: registers.answer(self._reachable(registers.six(6))),
            62: self._start_contact_detection,
            63: self._stop_contact_detection,
            64: lambda: registers.answer(self._contact_steps),
            65: self._set_target_payload,
            _CONTACT: self._after_contact,
        }

    # The loop

    def _main(self) -> Thread:
        self._registers.report_operation(running=False)
        self._registers.set_status(READY)
        executing = False
        while True:
            command = self._registers.integer(0)
            if command == 0:
                command, self._internal = self._internal, 0
            if command == _STOP_SCRIPT:
                return
            if command in _REALTIME:
                yield from self._carry_out(command)
                self._registers.set_status(READY)
            elif command == 0:
                executing = False
                self._registers.set_status(READY)
            elif not executing:
                yield from self._carry_out(command)
                executing = True
            yield

    def _carry_out(self, command: int) -> Thread:
        if command in self._commands:
            motion = self._commands[command]()
            if motion is not None:
                yield from motion
        # As the script: a command that it does not know, or that this version lacks, is done at once.
        self._registers.set_status(DONE)

    # Moves

    def _move_to(self, *, is_pose: bool, straight: bool) -> Thread:
        move = Move(
            tuple(self._registers.floats(0, 6)), is_pose, straight, self._registers.number(6), self._registers.number(7)
        )
        return self._start_move((move,))

    def _move_joints_to_pose(self) -> Thread:
        q = self._arm.inverse(pose_to_matrix(self._registers.floats(0, 6)), self._arm.q)
        return self._start_move(
            (Move(tuple(q.tolist()), False, False, self._registers.number(6), self._registers.number(7)),)
        )

    def _follow_path(self) -> Thread:
        return self._start_move(self._path, report=True)

    def _start_move(self, moves: Sequence[Move], *, report: bool = False) -> Thread:
        asynchronous = self._registers.integer(1) == 1
        self._stop_async_move()
        begin = (
            (lambda number: self._registers.report_operation(running=True, progress=number))
            if report
            else (lambda _: None)
        )
        motion = follow(self._arm, moves, begin)
        if not asynchronous:
            yield from motion
            return
        self._move = self.program.run(self._async_operation(motion))

    def _async_operation(self, motion: Thread) -> Thread:
        self._registers.report_operation(running=True)
        yield from motion
        self._registers.report_operation(running=False)

    def _stop_async_move(self) -> None:
        if self.program.alive(self._move):
            self.program.kill(self._move)
            self._registers.report_operation(running=False)
        self._move = None

    def _stop_command(self) -> Thread:
        deceleration, asynchronous = self._registers.number(0), self._registers.integer(1) == 1
        if self.program.alive(self._stop):
            self.program.kill(self._stop)
            self._registers.report_operation(running=False)
        else:
            self._stop_async_move()
        if asynchronous:
            self._async_stop_used = True
            self._stop = self.program.run(self._async_operation(stop_line(self._arm, deceleration)))
            return
        stop = stop_line if self._async_stop_used else stop_joints
        yield from stop(self._arm, deceleration)

    # Speed, servo, jog

    def _speed_command(self, *, line: bool) -> None:
        self._speed_args = (line, self._registers.six(0), self._registers.number(6), self._registers.number(7))
        if not self.program.alive(self._speed):
            self._speed = self.program.run(self._speed_thread())

    def _speed_thread(self) -> Thread:
        while True:
            line, target, acceleration, time = self._speed_args
            motion = speed_line if line else speed_joints
            yield from motion(self._arm, target, acceleration, max(time, 0.0))

    def _stop_speed(self) -> Thread:
        self.program.kill(self._speed)
        stop = stop_line if self._speed_args[0] else stop_joints
        yield from stop(self._arm, self._registers.number(0))

    def _servo_command(self, q: Array) -> None:
        time, lookahead, gain = self._registers.floats(8, 3)
        self._servo_args = (q, time, lookahead, gain)
        if not self._servoing():
            self._servo = self.program.run(self._servo_thread())

    def _servo_thread(self) -> Thread:
        while True:
            yield from servo_joints(self._arm, *self._servo_args)

    def _servo_circular_command(self) -> None:
        pose = self._registers.pose(0)
        self._circle_args = (pose, self._registers.number(6), self._registers.number(7))
        if not self._servoing():
            self._servo_circular = self.program.run(self._servo_circular_thread())

    def _servo_circular_thread(self) -> Thread:
        while True:
            yield from servo_circular(self._arm, *self._circle_args)

    def _servoing(self) -> bool:
        return self.program.alive(self._servo) or self.program.alive(self._servo_circular)

    def _stop_servo(self) -> Thread:
        self.program.kill(self._servo)
        self.program.kill(self._servo_circular)
        yield from stop_line(self._arm, self._registers.number(0))

    def _start_jog(self) -> None:
        speed, feature, acceleration = self._registers.six(0), int(self._registers.number(6)), self._registers.number(7)
        axes = {1: self._tool_axes(), 2: pose_to_matrix(self._registers.floats(8, 6))}.get(feature, np.eye(4))[:3, :3]
        self._jog_args = (np.concatenate([axes @ speed[:3], axes @ speed[3:]]), acceleration)
        if not self.program.alive(self._jog):
            self._jog = self.program.run(self._jog_thread())

    def _jog_thread(self) -> Thread:
        while True:
            speed, acceleration = self._jog_args
            yield from speed_line(self._arm, speed, acceleration, 0.01)

    def _stop_jog(self) -> Thread:
        self.program.kill(self._jog)
        yield from stop_line(self._arm, 1.2)

    def _tool_axes(self) -> Array:
        return self._arm.forward(self._arm.measured_q)

    # Contact and force

    def _move_until_contact(self) -> Thread:
        speed, direction, acceleration = (
            self._registers.six(0),
            self._registers.floats(6, 3),
            self._registers.number(12),
        )
        while True:
            steps = self._controller.history.contact_steps(direction)
            if steps > 0:
                yield from self._back_to_contact(steps)
                return
            yield from speed_line(self._arm, speed, acceleration, PERIOD_S)

    def _back_to_contact(self, steps: int) -> Thread:
        q = self._controller.history.joints_before(steps)
        yield from stop_line(self._arm, _CONTACT_STOP_M_S2)
        speed, acceleration = _BACK_TO_CONTACT
        yield from follow(self._arm, [Move(tuple(q.tolist()), False, True, speed, acceleration)])

    def _start_contact_detection(self) -> None:
        self.program.kill(self._contact)
        self._contact = self.program.run(self._contact_thread(self._registers.floats(0, 3)))

    def _contact_thread(self, direction: Sequence[float]) -> Thread:
        self._contact_steps = 0
        # As the script: a direction whose parts do not add up to more than nothing stands for that of the motion.
        towards_motion = sum(direction) < 1e-10

        def steps() -> int:
            if not towards_motion:
                return self._controller.history.contact_steps(direction)
            twist = self._arm.twist(self._arm.q, self._arm.momentum)
            return self._controller.history.contact_steps(twist.tolist())

        while steps() > 0:
            yield
        while not (found := steps()):
            yield
        self._contact_steps = found
        self._internal = _CONTACT

    def _stop_contact_detection(self) -> None:
        self.program.kill(self._contact)
        self._registers.answer(self._contact_steps)

    def _after_contact(self) -> Thread:
        self._stop_async_move()
        yield from self._back_to_contact(self._contact_steps)

    def _force_mode(self) -> None:
        kind, frame = self._registers.integer(1), pose_to_matrix(self._registers.floats(0, 6))
        selection = self._registers.selection()
        if kind == _POINT_FRAME:
            axes = towards_origin(frame, self._arm.forward(self._arm.q)[:3, 3])
        elif kind == _MOTION_FRAME:
            axes = along_motion(frame, self._arm.twist(self._arm.q, self._arm.momentum)[:3])
        else:
            axes = frame[:3, :3]
        self._arm.force_mode = ForceMode(axes, selection, self._registers.six(6), self._registers.six(12), self._gain)

    def _stop_force_mode(self) -> Thread:
        self._arm.force_mode = None
        yield from stop_line(self._arm, 10.0)

    def _set_gain(self) -> None:
        self._gain = min(max(self._registers.number(0), 0.0), 2.0)

    def _free(self, *, on: bool) -> None:
        self._arm.freedrive = on

    # Settings and sums

    def _set_payload(self) -> None:
        mass, *cog = self._registers.floats(0, 4)
        if mass < 0:
            raise ScriptError("set_payload: the mass must not be negative")
        old = self._controller.payload
        self._controller.set_payload(Payload(mass, tuple(cog) if any(cog) else old.cog, old.inertia))

    def _set_target_payload(self) -> None:
        mass, *rest = self._registers.floats(0, 10)
        if mass < 0:
            raise ScriptError("set_target_payload: the mass must not be negative")
        cog = tuple(rest[:3]) if any(rest[:3]) else self._controller.payload.cog
        self._controller.set_payload(Payload(mass, cog, tuple(rest[3:9])))

    def _set_gravity(self) -> None:
        self._controller.gravity = tuple(self._registers.floats(0, 3))

    def _set_watchdog(self) -> None:
        frequency = self._registers.number(0)
        if not frequency > 0:
            self._controller.watchdog = None
            return
        name = f"input_int_register_{self._offset}"
        self._controller.watchdog = Watchdog(name, 1 / frequency, self._controller.time)

    def _inverse(self, q_near: Array) -> None:
        self._registers.answer_floats(self._arm.inverse(pose_to_matrix(self._registers.floats(0, 6)), q_near).tolist())

    def _reachable(self, q_near: Array) -> bool:
        try:
            self._arm.inverse(pose_to_matrix(self._registers.floats(0, 6)), q_near)
        except ScriptError:
            return False
        return True

    def _forward(self) -> None:
        self._registers.answer_floats(
            matrix_to_pose(self._arm.flange(self._registers.six(0)) @ pose_to_matrix(self._registers.floats(6, 6)))
        )

    def _transform(self) -> None:
        self._registers.answer_floats(
            matrix_to_pose(pose_to_matrix(self._registers.floats(0, 6)) @ pose_to_matrix(self._registers.floats(6, 6)))
        )

    def _flange_pose(self) -> Pose:
        return matrix_to_pose(self._arm.flange(self._arm.measured_q))
