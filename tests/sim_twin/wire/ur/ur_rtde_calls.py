"""What the unmodified ur_rtde does with a served controller: run in a process of its own, it tells what it got.

Its constructors hold the interpreter and its calls can block for minutes, so the tests start this with a time limit:
python -m tests.sim_twin.wire.ur.ur_rtde_calls ADDRESS NAME prints the answers of one function below as JSON.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import TYPE_CHECKING, Any

import dashboard_client
import rtde_control
import rtde_io
import rtde_receive

if TYPE_CHECKING:
    from collections.abc import Callable

# Of the watchdog: a busy machine keeps a process from its kicks for 50 ms now and then, and for 250 ms hardly ever.
KICKS_HZ = 4.0
START = [0.0, -1.57, 1.57, -1.57, -1.57, 0.0]


def wait_for(condition: Callable[[], bool], limit: float = 10.0) -> bool:
    """Whether it comes about in time."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)
    return False


def settled(receive: Any) -> list[float]:
    """The joints, once they are where they were sent: they follow a few milliseconds late."""
    wait_for(lambda: max(abs(a - b) for a, b in zip(receive.getActualQ(), receive.getTargetQ(), strict=True)) < 1e-9)
    return list(receive.getActualQ())


def said(act: Callable[[], object]) -> str:
    """What a call raises."""
    try:
        act()
    except (RuntimeError, ValueError) as error:
        return str(error)
    return ""


def moves(host: str) -> dict[str, Any]:
    receive, control = rtde_receive.RTDEReceiveInterface(host), rtde_control.RTDEControlInterface(host)
    got: dict[str, Any] = {"moveJ": control.moveJ([0.3, *START[1:]], 2.0, 5.0)}
    got["q"] = settled(receive)
    pose = receive.getActualTCPPose()
    up = [*pose[:2], pose[2] + 0.05, *pose[3:]]
    got["moveL"] = control.moveL(up, 0.25, 1.2)
    settled(receive)
    got["raised"] = receive.getActualTCPPose()[2] - pose[2]
    got["moveJ_IK"] = control.moveJ_IK(pose, 1.0, 2.0)
    settled(receive)
    got["lowered"] = receive.getActualTCPPose()[2] - pose[2]
    got["moveL_FK"] = control.moveL_FK(START, 0.5, 2.0)
    number = control.getAsyncOperationProgressEx().operationId()
    control.moveJ([1.0, *START[1:]], 1.0, 5.0, True)
    got["begins"] = wait_for(lambda: control.getAsyncOperationProgressEx().operationId() != number)
    time.sleep(0.2)
    got["progress"] = control.getAsyncOperationProgress()
    control.stopJ(5.0)
    got["stopped at"] = receive.getActualQ()[0]
    got["ends"] = wait_for(lambda: control.getAsyncOperationProgress() < 0)
    got["steady"] = wait_for(control.isSteady)
    blend = [[0.2, *START[1:], 1.0, 5.0, 0.02], [0.2, -1.4, *START[2:], 1.0, 5.0, 0.02], [*START, 1.0, 5.0, 0.0]]
    got["path"] = control.moveJ(blend)
    got["path end"] = settled(receive)
    line = [[*up, 0.25, 1.0, 0.01], [up[0], up[1] + 0.05, *up[2:], 0.25, 1.0, 0.01], [*pose, 0.25, 1.0, 0.0]]
    control.moveL(line, True)
    seen: set[int] = set()
    wait_for(lambda: control.getAsyncOperationProgress() >= 0, 2.0)
    wait_for(lambda: seen.add(control.getAsyncOperationProgress()) or control.getAsyncOperationProgress() < 0)
    got["way points"] = sorted(number for number in seen if number >= 0)
    got["servo"] = _servo(control, receive)
    control.speedL([0, 0, 0.05, 0, 0, 0], 0.5, 0.01)
    time.sleep(0.4)
    got["speed"] = receive.getTargetTCPSpeed()[2]
    got["speedStop"] = control.speedStop()
    got["stopScript"] = control.stopScript()
    return got


def _servo(control: Any, receive: Any) -> float:
    q = receive.getActualQ()
    for _ in range(200):
        begin = control.initPeriod()
        q[0] += 0.0005
        control.servoJ(q, 0, 0, 0.002, 0.03, 1000)
        control.waitPeriod(begin)
    time.sleep(0.3)
    control.servoStop()
    return float(settled(receive)[0] - q[0])


def questions(host: str) -> dict[str, Any]:
    receive, control = rtde_receive.RTDEReceiveInterface(host), rtde_control.RTDEControlInterface(host)
    got: dict[str, Any] = {
        "setTcp": control.setTcp([0, 0, 0.2, 0, 0, 0]),
        "tcp": control.getTCPOffset(),
        "setPayload": control.setPayload(1.2, [0, 0, 0.05]),
    }
    control.moveJ(START, 2.0, 5.0)
    settled(receive)
    wait_for(lambda: receive.getPayload() == 1.2)
    pose, q = receive.getActualTCPPose(), receive.getActualQ()
    got["payload"] = [receive.getPayload(), *receive.getPayloadCog()]
    got["ik"] = control.getInverseKinematics(pose)
    got["ik near"] = control.getInverseKinematics(pose, q)
    got["has"] = [control.getInverseKinematicsHasSolution(pose), control.getInverseKinematicsHasSolution([3, *[0] * 5])]
    got["fk"] = control.getForwardKinematics(q, [0, 0, 0.2, 0, 0, 0])
    got["pose"] = pose
    got["trans"] = control.poseTrans([0.1, 0, 0, 0, 0, 0], [0, 0.2, 0, 0, 0, 0])
    got["within"] = [control.isPoseWithinSafetyLimits(pose), control.isJointsWithinSafetyLimits(q)]
    got["zero"] = control.zeroFtSensor()
    got["force"] = control.forceMode([0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -10, 0, 0, 0], 2, [0.1, 0.1, 0.05, 1, 1, 1])
    time.sleep(0.3)
    got["gives way"] = receive.getTargetTCPSpeed()[2]
    got["forceStop"] = control.forceModeStop()
    got["free"] = [control.freedriveMode(), control.endFreedriveMode(), control.teachMode(), control.endTeachMode()]
    got["jog"] = [control.jogStart([0, 0, 0.02, 0, 0, 0], 0), control.jogStop()]
    got["contact"] = [control.startContactDetection(), control.readContactDetection(), control.stopContactDetection()]
    got["custom"] = control.sendCustomScriptFunction("job", f"movej({START}, a=5, v=2)\nset_tcp(p[0,0,0,0,0,0])")
    got["after"] = [control.isProgramRunning(), control.getTCPOffset()]
    got["modes"] = [
        receive.getRobotMode(),
        receive.getSafetyMode(),
        receive.getRuntimeState(),
        receive.getRobotStatus(),
    ]
    got["unreachable"] = control.moveL([3, 0, 0, 0, 0, 0], 0.1, 0.1)
    got["dead"] = control.isProgramRunning()
    got["reupload"] = control.reuploadScript() and wait_for(control.isProgramRunning)
    got["second"] = said(lambda: rtde_control.RTDEControlInterface(host))
    got["unknown"] = said(lambda: rtde_receive.RTDEReceiveInterface(host, 500.0, ["nonsense"]))
    control.disconnect()
    got["third"] = rtde_control.RTDEControlInterface(host).isConnected()
    return got


def outputs(host: str) -> dict[str, Any]:
    receive, io = rtde_receive.RTDEReceiveInterface(host), rtde_io.RTDEIOInterface(host)
    got: dict[str, Any] = {
        "set": [
            io.setStandardDigitalOut(1, True),
            io.setConfigurableDigitalOut(2, True),
            io.setToolDigitalOut(0, True),
            io.setAnalogOutputVoltage(0, 0.5),
            io.setInputIntRegister(18, 7),
            io.setSpeedSlider(0.5),
        ]
    }
    wait_for(lambda: receive.getTargetSpeedFraction() == 0.5)
    got["bits"] = receive.getActualDigitalOutputBits()
    got["analog"] = receive.getStandardAnalogOutput0()
    io.setSpeedSlider(1.0)
    got["slider"] = wait_for(lambda: receive.getTargetSpeedFraction() == 1.0)
    io.setStandardDigitalOut(1, False)
    got["off"] = wait_for(lambda: receive.getActualDigitalOutputBits() == got["bits"] & ~2)
    return got


def stops(host: str) -> dict[str, Any]:
    receive, control = rtde_receive.RTDEReceiveInterface(host), rtde_control.RTDEControlInterface(host)
    dashboard = dashboard_client.DashboardClient(host)
    dashboard.connect()
    control.moveJ([1.0, *START[1:]], 0.5, 2.0, True)
    time.sleep(0.3)
    dashboard.pause()
    got: dict[str, Any] = {"paused": wait_for(lambda: receive.getRuntimeState() == 4)}
    dashboard.play()
    got["resumed"] = wait_for(lambda: receive.getRuntimeState() == 2)
    time.sleep(0.2)
    control.triggerProtectiveStop()
    got["protective"] = wait_for(receive.isProtectiveStopped)
    got["state"] = [receive.getSafetyMode(), receive.getRuntimeState(), control.isProgramRunning()]
    got["refused"] = control.moveJ(START, 1.0, 2.0)
    got["early"] = said(dashboard.unlockProtectiveStop)
    # The served controller of the tests can be unlocked after 2 s.
    time.sleep(2.1)
    dashboard.closeSafetyPopup()
    dashboard.unlockProtectiveStop()
    control.reuploadScript()
    got["recovered"] = wait_for(control.isProgramRunning) and control.moveJ(START, 2.0, 5.0)
    control.setWatchdog(KICKS_HZ)
    control.speedL([0, 0, 0.05, 0, 0, 0], 0.5, 0.01)
    for _ in range(20):
        time.sleep(0.02)
        control.kickWatchdog()
    got["kicked"] = control.isProgramRunning()
    got["tripped"] = wait_for(lambda: not control.isProgramRunning(), 1.0)
    dashboard.powerOff()
    got["off"] = wait_for(lambda: receive.getRobotMode() == 3)
    got["robotmode"] = dashboard.robotmode()
    dashboard.powerOn()
    dashboard.brakeRelease()
    got["on"] = wait_for(lambda: receive.getRobotMode() == 7)
    got["words"] = [
        dashboard.polyscopeVersion(),
        dashboard.programState(),
        dashboard.isInRemoteControl(),
        dashboard.getSerialNumber(),
        dashboard.safetymode(),
        dashboard.running(),
    ]
    return got


def speeds(host: str) -> None:
    """Keep the arm moving under a watchdog until somebody ends this process."""
    control = rtde_control.RTDEControlInterface(host)
    control.setWatchdog(KICKS_HZ)
    control.speedL([0, 0.1, 0, 0, 0, 0], 1.0, 0.01)
    sys.stdout.write("moving\n")
    sys.stdout.flush()
    while True:
        control.kickWatchdog()
        time.sleep(0.01)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(globals()[sys.argv[2]](sys.argv[1])) + "\n")
    sys.stdout.flush()
    # Destructors of ur_rtde take seconds.
    os._exit(0)
