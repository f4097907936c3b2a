"""Looks at every device of a hardware cell at once and says what is wrong. Never moves anything.

Each device is examined by its driver's own means, so that what the doctor accepts a job can open; the arm is only
watched, since taking control of it would start a program on it.
"""

from __future__ import annotations

import enum
import platform
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robotcell.drivers.backend import HardwareOptions
from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415
from robotcell.drivers.rg2 import RG2
from robotcell.drivers.ur5e.controller import IN_USE_CURE, inputs_in_use, inspect, obstacles, program_held
from robotcell.drivers.ur5e.dashboard import Dashboard
from robotcell.drivers.ur5e.rtde import as_number, open_rtde
from robotcell.errors import CellError, ConfigError
from robotcell.geometry import rg2
from robotcell.geometry.transforms import matrix_to_rotvec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from robotcell.config import CameraMount, CellConfig
    from robotcell.drivers.d415.camera import D415Options
    from robotcell.drivers.rg2 import RG2Options
    from robotcell.drivers.ur5e.arm import UR5eOptions

_SDKS = ("ur_rtde", "pymodbus", "pyrealsense2")
_UDEV_FOLDERS = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
# Vendor and product of the D415 on USB.
_UDEV_IDS = ("8086", "0ad3")
_RTDE_HZ = 125.0
_DASHBOARD_ASKS = 20
_GRIPPER_PERIOD_S = 0.02
_MIN_RATE = 0.95
_MAX_GRIPPER_S = 0.05
_MIN_FRAME_RATE = 25.0
_LINK_ADVICE = (
    "use a cable straight to the controller, or a switch of its own, no Wi-Fi or office network; less load on this "
    "computer"
)
# The inputs that ur_rtde takes.
_INPUTS = (*(f"input_int_register_{i}" for i in range(8)), *(f"input_double_register_{i}" for i in range(18)))


class Grade(enum.Enum):
    """How good a finding is."""

    OK = "ok"
    NOTE = "note"  # works, and could be better
    WRONG = "wrong"  # a job cannot run, or not safely


@dataclass(frozen=True)
class Finding:
    """One row of the report; `cure` says what to do where the grade is not OK."""

    device: str
    what: str
    value: str
    grade: Grade = Grade.OK
    cure: str = ""


def examine(config: CellConfig, seconds: float) -> list[Finding]:
    """Examine the cell of a configuration, all devices at once.

    Args:
        config: of the backend `hardware`.
        seconds: how long latencies are measured.

    Raises:
        ConfigError: its backend is another one.
    """
    if config.backend.name != "hardware":
        raise ConfigError(
            f"the doctor examines cells of the backend 'hardware', and this one's is {config.backend.name!r}: give a "
            "cell file such as examples/hardware.toml by --cell"
        )
    options = HardwareOptions.model_validate(config.backend.options)
    rounds: list[tuple[str, Callable[[], Iterator[Finding]]]] = [
        ("computer", lambda: _examine_computer(options)),
        ("arm", lambda: _examine_arm(options.arm, seconds, config.limits.state_age_s)),
        ("gripper", lambda: _examine_gripper(options.gripper, seconds)),
        ("camera", lambda: _examine_camera(options.camera, config.camera, seconds)),
        ("calibration", lambda: _examine_calibration(config.camera)),
    ]
    with ThreadPoolExecutor(len(rounds)) as pool:
        return [finding for found in pool.map(lambda args: _collect(*args), rounds) for finding in found]


def _collect(device: str, look: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """What a round finds, up to the error that ends it."""
    found: list[Finding] = []
    try:
        found.extend(look())
    except CellError as error:
        found.append(Finding(device, "reach" if not found else "further", "failed", Grade.WRONG, str(error)))
    return found


def _examine_computer(options: HardwareOptions) -> Iterator[Finding]:
    yield Finding("computer", "python", f"{platform.python_version()} on {platform.platform(terse=True)}")
    for name in _SDKS:
        try:
            yield Finding("computer", name, version(name))
        except PackageNotFoundError:
            yield Finding("computer", name, "missing", Grade.WRONG, "pip install 'robotcell[hardware]'")
    if options.camera.source == "usb" and sys.platform == "linux":
        yield _examine_udev()


def _examine_udev() -> Finding:
    for folder in _UDEV_FOLDERS:
        for path in sorted(Path(folder).glob("*.rules")):
            text = path.read_text(encoding="utf-8", errors="replace").lower()
            if all(number in text for number in _UDEV_IDS):
                return Finding("computer", "udev rule", str(path))
    cure = "install the camera's udev rule as docs/hardware.md says; without it only root can open the camera"
    return Finding("computer", "udev rule", "missing", Grade.WRONG, cure)


def _examine_arm(options: UR5eOptions, seconds: float, state_age_s: float) -> Iterator[Finding]:
    controller = inspect(options.host)
    yield Finding("arm", "PolyScope", ".".join(map(str, controller.version)))
    yield Finding("arm", "model, serial", f"{controller.model}, {controller.serial}")
    yield Finding("arm", "remote control", "on" if controller.remote else "off")
    yield Finding("arm", "speed slider", f"{100 * controller.speed_fraction:.0f} %")
    for cure in obstacles(controller):
        yield Finding("arm", "ready", "no", Grade.WRONG, cure)
    if controller.protective_stop:
        yield Finding("arm", "safety", "protective stop", Grade.WRONG, "look at the cell, then robotcell recover")
    held = program_held(controller.runtime_state)
    yield Finding("arm", "program", held or "none runs", Grade.WRONG if held else Grade.OK, held)
    T = rg2.T_FLANGE_TCP
    tcp = (*T[:3, 3], *matrix_to_rotvec(T[:3, :3]))
    yield _compare("TCP [m, rad]", controller.tcp_offset, tcp, 1e-4)
    yield _compare("payload [kg]", (controller.payload_kg,), (options.payload_kg,), 1e-3)
    in_use = inputs_in_use(options.host, _INPUTS)
    yield Finding(
        "arm",
        "RTDE inputs",
        f"{len(in_use)} in use" if in_use else "free",
        Grade.WRONG if in_use else Grade.OK,
        f"{', '.join(in_use)}: {IN_USE_CURE}" if in_use else "",
    )
    yield from _time_rtde(options.host, seconds, state_age_s)
    yield _time_dashboard(options.host)


def _compare(what: str, found: tuple[float, ...], wanted: tuple[float, ...], tolerance: float) -> Finding:
    text = ", ".join(f"{value:.4g}" for value in found)
    if np.allclose(found, wanted, atol=tolerance):
        return Finding("arm", what, text)
    cell = ", ".join(f"{value:.4g}" for value in wanted)
    cure = f"the cell's is {cell}: it is set at connect; enter it in the installation too, for jogging and freedrive"
    return Finding("arm", what, text, Grade.NOTE, cure)


def _time_rtde(host: str, seconds: float, state_age_s: float) -> Iterator[Finding]:
    """Rate and lateness of the controller's data; beyond the age that the safety layer allows, motions are stopped."""
    stamps: list[float] = []
    arrivals: list[float] = []
    with open_rtde(host) as rtde:
        rtde.start(["timestamp"], _RTDE_HZ)
        end = time.monotonic() + seconds
        while not arrivals or arrivals[-1] < end:
            stamps.append(as_number(rtde.read()["timestamp"]))
            arrivals.append(time.monotonic())
    stamp, arrival = np.array(stamps, dtype=np.float64), np.array(arrivals)
    rate = (len(stamp) - 1) / (arrival[-1] - arrival[0]) if len(stamp) > 1 else 0.0
    gap = float(np.diff(arrival).max()) if len(stamp) > 1 else seconds
    late_ms = 1000 * (arrival - stamp - (arrival - stamp).min())
    grade = Grade.OK
    if rate < _MIN_RATE * _RTDE_HZ or gap > state_age_s:
        grade = Grade.WRONG
    elif gap > state_age_s / 2:
        grade = Grade.NOTE
    yield Finding(
        "arm",
        "RTDE",
        f"{rate:.1f} Hz of {_RTDE_HZ:.0f}, longest gap {1000 * gap:.0f} ms, late by {np.median(late_ms):.1f} ms "
        f"(99 %: {np.percentile(late_ms, 99):.1f} ms)",
        grade,
        "" if grade is Grade.OK else _LINK_ADVICE,
    )


def _time_dashboard(host: str) -> Finding:
    dashboard = Dashboard(host)
    took: list[float] = []
    try:
        dashboard.connect()
        for _ in range(_DASHBOARD_ASKS):
            begin = time.monotonic()
            dashboard.ask("robotmode")
            took.append(time.monotonic() - begin)
    finally:
        dashboard.close()
    return Finding("arm", "dashboard", f"answers in {_milliseconds(took)}")


def _examine_gripper(options: RG2Options, seconds: float) -> Iterator[Finding]:
    clock = WallClock()
    with RG2(options, clock) as gripper:
        yield Finding("gripper", "Compute Box", f"{options.host}:{options.port}, unit {options.unit}")
        yield Finding("gripper", "RG2", f"firmware {gripper.firmware()}")
        state = gripper.state()
        yield Finding("gripper", "state", f"{1000 * state.width_m:.1f} mm, {'busy' if state.busy else 'at rest'}")
        took: list[float] = []
        end = time.monotonic() + seconds
        while not took or time.monotonic() < end:
            begin = time.monotonic()
            gripper.state()
            took.append(time.monotonic() - begin)
            clock.sleep(_GRIPPER_PERIOD_S)
    slow = statistics.median(took) > _MAX_GRIPPER_S
    yield Finding(
        "gripper",
        "Modbus",
        f"answers in {_milliseconds(took)}",
        Grade.WRONG if slow else Grade.OK,
        "use a cable straight to the Compute Box" if slow else "",
    )


def _examine_camera(options: D415Options, mount: CameraMount, seconds: float) -> Iterator[Finding]:
    clock = WallClock()
    with D415(options, mount, clock) as camera:
        yield Finding("camera", "device", camera.description)
        stamps: list[float] = []
        ages: list[float] = []
        numbers: list[int] = []
        end = time.monotonic() + seconds
        while not stamps or time.monotonic() < end:
            frame = camera.read()
            stamps.append(frame.t)
            ages.append(clock.now() - frame.t)
            numbers.append(frame.number)
    yield Finding("camera", "mode", f"{frame.intrinsics.width}x{frame.intrinsics.height}, fx {frame.intrinsics.fx:.1f}")
    share = float((frame.depth_m > 0).mean())
    yield Finding("camera", "depth", f"{share:.0%} of the pixels")
    rate = (numbers[-1] - numbers[0]) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else 0.0
    slow = rate < _MIN_FRAME_RATE
    yield Finding(
        "camera",
        "frames",
        f"{rate:.1f} per second, old by {_milliseconds(ages)}",
        Grade.WRONG if slow else Grade.OK,
        "a USB 3 port of its own, and less load on this computer" if slow else "",
    )


def _examine_calibration(mount: CameraMount) -> Iterator[Finding]:
    if mount.calibration is None:
        yield Finding(
            "calibration",
            "file",
            "none",
            Grade.NOTE,
            "camera.calibration names none: the pose is what cell.toml says; calibrate for millimetres",
        )
        return
    measured = mount.measured
    if measured is None:
        raise ConfigError(f"{mount.calibration}: not loaded")
    yield Finding(
        "calibration",
        "file",
        f"{mount.calibration}, {measured.date:%Y-%m-%d}, {measured.views} views, held out "
        f"{measured.held_out.mm.median:.1f} mm, camera {measured.camera.serial or 'not named'}",
    )
    measured.check(resolution=mount.size)
    yield Finding("calibration", "fits", f"{mount.resolution}, not too old")


def _milliseconds(took: list[float]) -> str:
    return f"{1000 * statistics.median(took):.1f} ms (99 %: {1000 * float(np.percentile(took, 99)):.1f} ms)"
